"""Makes the things of the gallery: textured meshes in metres, and a room to film them in.

A tea tin, a mug, a ball and a toy truck are built from patches, rectangular grids of points that each show a picture of
their own; all pictures of a thing lie side by side in its texture. What is done with them is in docs/gallery.md.

$ python docs/images/gallery_things.py things
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

Points = NDArray[np.float64]
Patch = tuple[Points, Image.Image]
"""Points ``(rows, columns, 3)``, y up, whose normals come towards one who sees the first row above and the first column
to the left; and the picture that is seen then."""

TILE = 320
INSET = 2.0
"""Pixels of a picture's border that are not shown, so that none of its neighbours is."""


def label(colour: str, lines: dict[tuple[float, float, float], tuple[str, str]]) -> Image.Image:
    """A picture of one colour with words on it: (x, y, size) in parts of its side -> (text, colour)."""
    picture = Image.new("RGB", (TILE, TILE), colour)
    pen = ImageDraw.Draw(picture)
    for (x, y, size), (text, ink) in lines.items():
        pen.text((x * TILE, y * TILE), text, ink, ImageFont.load_default(size * TILE), anchor="mm")
    return picture


def leaves(picture: Image.Image, colours: list[str], seed: int, count: int = 26) -> Image.Image:
    """The picture with leaves strewn over it."""
    rng = np.random.default_rng(seed)
    pen = ImageDraw.Draw(picture)
    for n in range(count):
        x, y, angle = *rng.uniform(0, TILE, 2).tolist(), rng.uniform(0, np.pi)
        t = np.linspace(0, 2 * np.pi, 24)
        along, across = 22 * np.cos(t), 8 * np.sin(t)
        xs, ys = (
            x + along * np.cos(angle) - across * np.sin(angle),
            y + along * np.sin(angle) + across * np.cos(angle),
        )
        pen.polygon(list(zip(xs.tolist(), ys.tolist(), strict=True)), fill=colours[n % len(colours)])
        pen.line([(xs[0], ys[0]), (xs[12], ys[12])], fill="#20302a", width=1)
    return picture


def small_print(colour: str, ink: str, seed: int) -> Image.Image:
    """A table, a few lines and a bar code, as on the back of a package."""
    rng = np.random.default_rng(seed)
    picture = Image.new("RGB", (TILE, TILE), colour)
    pen = ImageDraw.Draw(picture)
    for row in range(8):
        y = 24 + 18 * row
        pen.line([(24, y), (24 + rng.uniform(90, 190), y)], fill=ink, width=5)
        pen.line([(250, y), (250 + rng.uniform(15, 45), y)], fill=ink, width=5)
    x = 40.0
    while x < 280:
        width = rng.choice([2, 4, 7])
        pen.rectangle([x, 200, x + width - 1, 290], fill=ink)
        x += width + rng.choice([2, 3, 5])
    return picture


def flat(corner: tuple[float, ...], right: tuple[float, ...], down: tuple[float, ...]) -> Points:
    """A rectangle from its upper left corner and two sides."""
    s, t = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9))
    return np.array(corner) + s[..., None] * np.array(right) + t[..., None] * np.array(down)


def block(
    centre: tuple[float, float, float], size: tuple[float, float, float], faces: list[Image.Image]
) -> list[Patch]:
    """A box; pictures of its front, right, back, left, top and bottom side."""
    (x, y, z), (w, h, d) = centre, (side / 2 for side in size)
    sides = [
        flat((x - w, y + h, z + d), (2 * w, 0, 0), (0, -2 * h, 0)),
        flat((x + w, y + h, z + d), (0, 0, -2 * d), (0, -2 * h, 0)),
        flat((x + w, y + h, z - d), (-2 * w, 0, 0), (0, -2 * h, 0)),
        flat((x - w, y + h, z - d), (0, 0, 2 * d), (0, -2 * h, 0)),
        flat((x - w, y + h, z - d), (2 * w, 0, 0), (0, 0, 2 * d)),
        flat((x - w, y - h, z + d), (2 * w, 0, 0), (0, 0, -2 * d)),
    ]
    return list(zip(sides, faces, strict=True))


def turned(profile: list[tuple[float, float]], steps: int = 64) -> Points:
    """A surface of revolution about y, from (radius, height) above to below as it is seen from outside."""
    around = np.linspace(0, 2 * np.pi, steps + 1)
    radius, height = np.array(profile).T
    x, z = radius[:, None] * np.sin(around), radius[:, None] * np.cos(around)
    return np.stack([x, np.broadcast_to(height[:, None], x.shape), z], -1)


def wheel(
    centre: tuple[float, float, float], radius: float, width: float, tread: Image.Image, side: Image.Image
) -> list[Patch]:
    """A wheel about z; the picture of its sides lies flat on them."""
    edge = turned([(radius, width / 2), (radius, -width / 2)], 32)[..., [2, 0, 1]]
    s, t = np.meshgrid(np.linspace(-1, 1, 17), np.linspace(1, -1, 17))
    long = np.maximum(np.abs(s), np.abs(t)) / np.hypot(s, t).clip(1e-9)
    disc = radius * np.stack([s * long, t * long, 0 * s], -1)
    out = np.array([0, 0, width / 2])
    front, back = disc + out, disc * (-1, 1, 1) - out
    return [
        (np.array(centre) + points, picture)
        for points, picture in ((edge, tread), (front, side), (back, side))
    ]


def handle(reach: float, height: float, thickness: float, at: float) -> Points:
    """Half a ring at the right, from above to below."""
    ring, around = np.linspace(0, np.pi, 25)[:, None], np.linspace(0, 2 * np.pi, 17)
    out = np.sin(ring) * (reach + thickness * np.cos(around))
    up = np.cos(ring) * (height + thickness * np.cos(around))
    return np.stack([at + out, up, -thickness * np.sin(around) * np.ones_like(out)], -1)


def tin() -> list[Patch]:
    """Printed on all sides."""
    front = leaves(label("#1f6f54", {}), ["#7fb069", "#c9d8a4"], 1)
    pen = ImageDraw.Draw(front)
    pen.ellipse([40, 70, 280, 250], fill="#f4ead2", outline="#c8963e", width=6)
    pen.text((160, 135), "TEA", "#7a2e1d", ImageFont.load_default(84), anchor="mm")
    pen.text((160, 205), "first harvest", "#1f6f54", ImageFont.load_default(30), anchor="mm")
    side = leaves(label("#c8963e", {(0.5, 0.3, 0.14): ("125 g", "#3b1f10")}), ["#1f6f54", "#7a2e1d"], 2, 12)
    other = leaves(label("#1f6f54", {(0.5, 0.5, 0.2): ("No 7", "#f4ead2")}), ["#c8963e", "#7fb069"], 3, 14)
    lid = label("#c8963e", {(0.5, 0.5, 0.3): ("LID", "#7a2e1d"), (0.5, 0.8, 0.1): ("keep dry", "#3b1f10")})
    return block(
        (0, 0, 0), (0.09, 0.13, 0.07), [front, side, small_print("#f4ead2", "#3b1f10", 4), other, lid, lid]
    )


def mug() -> list[Patch]:
    """White, with a print around it, and a handle with a hole."""
    around = Image.new("RGB", (3 * TILE, TILE))
    for n, (word, ink) in enumerate([("good", "#2e4057"), ("new", "#edae49"), ("day", "#d1495b")]):
        third = leaves(label("#efeae0", {}), ["#d1495b", "#2e4057", "#edae49"], 5 + n, 12)
        pen = ImageDraw.Draw(third)
        pen.rectangle([0, 0, TILE, 26], fill="#2e4057")
        pen.rectangle([0, 290, TILE, TILE], fill="#d1495b")
        pen.text((160, 160), word, ink, ImageFont.load_default(110), anchor="mm")
        around.paste(third, (n * TILE, 0))
    outside = [(0.040, 0.05), (0.040, 0.0), (0.040, -0.045), (0.036, -0.05)]
    bottom, plain = [(0.036, -0.05), (1e-4, -0.05)], label("#efeae0", {})
    inside = [(1e-4, -0.045), (0.034, -0.043), (0.036, 0.05), (0.040, 0.05)]
    return [
        (turned(outside), around),
        (turned(bottom), label("#c9bfae", {})),
        (turned(inside), label("#b9c4c9", {})),
        (handle(0.03, 0.028, 0.006, 0.037), plain),
    ]


def ball() -> list[Patch]:
    """Six panels with figures: its outline is the same from all sides."""
    picture = Image.new("RGB", (2 * TILE, TILE))
    for n, colour in enumerate(["#d1495b", "#f4ead2", "#2e86ab", "#edae49", "#3b7d4f", "#e8e8e8"]):
        panel = label(
            colour, {(0.5, 0.32, 0.22): (str(n + 1), "#22223b"), (0.5, 0.66, 0.12): ("BALL", "#22223b")}
        )
        marked = leaves(panel, ["#22223b", "#ffffff"], 10 + n, 5)
        picture.paste(marked.resize((2 * TILE // 6 + 1, TILE)), (2 * TILE // 6 * n, 0))
    angles = np.linspace(1e-3, np.pi - 1e-3, 33)
    return [(turned([(0.09 * np.sin(a), 0.09 * np.cos(a)) for a in angles]), picture)]


def truck() -> list[Patch]:
    """Painted wood: few marks, many corners, and axles that one can look through."""
    red, blue, wood = label("#b5312c", {}), label("#2b5d8a", {}), label("#c79a63", {})
    number = label("#b5312c", {(0.5, 0.5, 0.6): ("12", "#f4ead2")})
    name = label("#c79a63", {(0.5, 0.5, 0.3): ("TIMBER", "#4a2c12")})
    window = label("#2b5d8a", {})
    ImageDraw.Draw(window).rectangle([50, 40, 270, 170], fill="#cfe3ee", outline="#16324a", width=8)
    rubber, tyre = label("#26221f", {}), label("#26221f", {})
    ImageDraw.Draw(tyre).ellipse([110, 110, 210, 210], fill="#d8b04a")
    patches = block((-0.035, 0.012, 0), (0.11, 0.012, 0.07), [name, wood, name, wood, wood, wood])
    patches += block((0.05, 0.03, 0), (0.05, 0.07, 0.07), [window, number, window, blue, red, blue])
    for z in (0.026, 0.0, -0.026):
        patches += block((-0.035, 0.03, z), (0.105, 0.02, 0.018), [red, wood, name, wood, wood, red])
    for x in (-0.07, 0.045):
        for z in (-0.034, 0.034):
            patches += wheel((x, -0.012, z), 0.017, 0.014, rubber, tyre)
    return patches


def mesh_of(patches: list[Patch]) -> trimesh.Trimesh:
    """One mesh with one texture."""
    pictures = list({id(picture): picture for _, picture in patches}.values())
    columns = max(picture.width for picture in pictures) // TILE * int(np.ceil(np.sqrt(len(pictures))))
    places, x, y = {}, 0, 0
    for picture in pictures:
        if x + picture.width > columns * TILE:
            x, y = 0, y + TILE
        places[id(picture)] = x, y
        x += picture.width
    sheet = Image.new("RGB", (columns * TILE, y + TILE))
    vertices, faces, uvs, first = [], [], [], 0
    for points, picture in patches:
        left, top = places[id(picture)]
        sheet.paste(picture, (left, top))
        rows, wide = points.shape[:2]
        s, t = np.meshgrid(np.linspace(0, 1, wide), np.linspace(0, 1, rows))
        u = left + INSET + s * (picture.width - 2 * INSET)
        v = top + INSET + t * (TILE - 2 * INSET)
        uvs.append(np.stack([u / sheet.width, 1 - v / sheet.height], -1).reshape(-1, 2))
        vertices.append(points.reshape(-1, 3))
        n = first + np.arange(rows * wide).reshape(rows, wide)
        a, b, c, d = n[:-1, :-1].ravel(), n[1:, :-1].ravel(), n[1:, 1:].ravel(), n[:-1, 1:].ravel()
        faces += [np.stack([a, b, c], -1), np.stack([a, c, d], -1)]
        first += rows * wide
    visual = trimesh.visual.TextureVisuals(np.concatenate(uvs), image=sheet)
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), visual=visual, process=False)


def room(width: int = 800, height: int = 600) -> NDArray[np.uint8]:
    """A shelf with books before a wall, and a table of planks, a little out of focus."""
    rng = np.random.default_rng(8)
    picture = Image.new("RGB", (width, height), "#b9b2a3")
    pen = ImageDraw.Draw(picture)
    pen.rectangle([0, 215, width, 232], fill="#6d5138")
    x = 20.0
    while x < width - 40:
        wide, tall = rng.uniform(14, 40), rng.uniform(110, 175)
        colour = tuple(rng.integers(40, 190, 3).tolist())
        pen.rectangle([x, 215 - tall, x + wide, 214], fill=colour)
        pen.rectangle([x + 3, 215 - 0.8 * tall, x + wide - 3, 215 - 0.7 * tall], fill="#d9cfb8")
        x += wide + rng.choice([1.0, 1.0, 18.0])
    pen.rectangle([0, 400, width, height], fill="#8a6240")
    for y in range(400, height, 40):
        pen.rectangle(
            [0, y, width, y + 38], fill=tuple((np.array([138, 98, 64]) + rng.integers(-14, 14)).tolist())
        )
        for _ in range(30):
            left, at = rng.uniform(0, width), y + rng.uniform(3, 36)
            pen.line(
                [(left, at), (left + rng.uniform(40, 220), at + rng.uniform(-2, 2))], fill="#76512f", width=1
            )
    image = cv2.GaussianBlur(np.asarray(picture).astype(np.float32), (0, 0), 2.2)
    light = np.linspace(1.12, 0.85, width)[None, :, None] * np.linspace(1.0, 0.9, height)[:, None, None]
    return (image * light + rng.normal(0, 2.5, image.shape)).clip(0, 255).astype(np.uint8)


def main() -> None:
    """Write the meshes and the room."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    (folder / "rooms").mkdir(parents=True, exist_ok=True)
    for thing in (tin, mug, ball, truck):
        mesh_of(thing()).export(folder / f"{thing.__name__}.glb")
    Image.fromarray(room()).save(folder / "rooms" / "room.png")


if __name__ == "__main__":
    main()
