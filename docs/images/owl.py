"""Makes a painted owl of clay, and films it on a turntable in front of a still camera: the clip of the README's picture.

The owl is a union of smooth bodies, seen from its middle: one radius for every direction. Its glaze is painted on that
sphere of directions. The table, the wall behind it and the shadow are ray cast once, the owl in every frame; noise and
compression are those of `tracking3d synth`.

$ python docs/images/owl.py clips/owl
$ tracking3d run clips/owl/frames --box "$(python docs/images/owl.py clips/owl --box)" --model fine --out runs/owl
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tracking3d.datasets.clip import write_clip
from tracking3d.synthesis.camera_effects import compressed, linear
from tracking3d.synthesis.frame_rendering import render_frame
from tracking3d.synthesis.lighting import lamp_at
from tracking3d.synthesis.motions import Path as Motion
from tracking3d.synthesis.ray_casting import Surface
from tracking3d.synthesis.room import Room
from tracking3d.synthesis.room_rendering import room_light
from tracking3d.synthesis.scene import Scene, make_scene
from tracking3d.synthesis.spec import Disturbances, SequenceSpec
from tracking3d.synthesis.texture_lookup import pyramid

Array = NDArray[np.float64]

METRES = 0.08
"""Half of the owl's height."""
ROWS, COLUMNS = 160, 320
TEXELS = 1024
"""Rows of the texture, from the top of the sphere of directions to the bottom; it has twice as many columns."""
TILT = 18.0
"""Degrees that the camera looks down."""
LIGHTS = 32
"""Samples of the still picture behind the owl; each sees the shadow of another moment of the turn."""

CREAM, RUST, TEAL, MUSTARD, INK = "#efe2c6", "#a8481f", "#1d5560", "#d79a2b", "#2a1c14"
BODY, HEAD, WING, CLAW, BEAK, EYE, BASE = range(7)


# The shape: signed distances, negative inside; x to the owl's left, y up, z to where it looks.


def ellipsoid(p: Array, centre: tuple[float, ...], radii: tuple[float, ...], turn: float = 0.0) -> Array:
    """About the distance to an ellipsoid that is turned about z."""
    c, s = np.cos(turn), np.sin(turn)
    q = (p - centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    scaled = np.linalg.norm(q / radii, axis=-1)
    return scaled * (scaled - 1) / np.linalg.norm(q / np.square(radii), axis=-1).clip(1e-9)


def horn(p: Array, foot: tuple[float, ...], tip: tuple[float, ...], thick: float, thin: float) -> Array:
    """A round rod that gets thinner."""
    a, ab = np.array(foot), np.subtract(tip, foot)
    t = ((p - a) @ ab / (ab @ ab)).clip(0, 1)
    return np.linalg.norm(p - a - t[..., None] * ab, axis=-1) - thick - (thin - thick) * t


def plinth(p: Array) -> Array:
    """A disc with a rounded edge."""
    d = np.stack([np.hypot(p[..., 0], p[..., 2]) - 0.50, np.abs(p[..., 1] + 0.92) - 0.05], -1)
    return np.linalg.norm(d.clip(0), axis=-1) + d.max(-1).clip(max=0) - 0.03


def parts(p: Array) -> list[tuple[int, float, Array]]:
    """What each part is painted as, how softly it blends into the others, and its distances."""
    found = [
        (BODY, 0.10, ellipsoid(p, (0, -0.30, 0), (0.59, 0.76, 0.54))),
        (HEAD, 0.10, ellipsoid(p, (0, 0.46, 0.05), (0.50, 0.38, 0.43))),
        (BODY, 0.10, horn(p, (0, -0.35, -0.36), (0, -0.72, -0.54), 0.20, 0.12)),
        (BEAK, 0.03, horn(p, (0, 0.47, 0.46), (0, 0.33, 0.58), 0.09, 0.025)),
        (BASE, 0.06, plinth(p)),
    ]
    for side in (-1, 1):
        found += [
            (HEAD, 0.08, horn(p, (side * 0.25, 0.68, 0.05), (side * 0.40, 0.98, 0.0), 0.15, 0.035)),
            (EYE, 0.03, ellipsoid(p, (side * 0.19, 0.52, 0.38), (0.15, 0.15, 0.10))),
            (WING, 0.04, ellipsoid(p, (side * 0.52, -0.22, -0.05), (0.13, 0.50, 0.38), side * 0.14)),
            (CLAW, 0.03, ellipsoid(p, (side * 0.19, -0.80, 0.36), (0.13, 0.10, 0.16))),
        ]
    return found


def distance(p: Array) -> Array:
    """To the owl: the smooth minimum of its parts' (a polynomial of the second degree where they meet)."""
    (_, _, joined), *others = parts(p)
    for _, blend, other in others:
        meet = (0.5 + 0.5 * (other - joined) / blend).clip(0, 1)
        joined = other + (joined - other) * meet - blend * meet * (1 - meet)
    return joined


def surface() -> Array:
    """``(ROWS + 1, COLUMNS + 1, 3)`` points in all directions from the middle, walked to from outside."""
    polar, around = np.meshgrid(
        np.linspace(1e-3, np.pi - 1e-3, ROWS + 1), np.linspace(-np.pi, np.pi, COLUMNS + 1), indexing="ij"
    )
    towards = np.stack(
        [np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], axis=-1
    )
    away = np.full(polar.shape, 1.6)
    for _ in range(120):
        away = (away - 0.6 * distance(away[..., None] * towards)).clip(0.05)
    return away[..., None] * towards


# The glaze.


def colour(name: str) -> Array:
    """``(3,)`` in [0, 255]."""
    return np.array([int(name[n : n + 2], 16) for n in (1, 3, 5)], np.float64)


def put(picture: Array, where: Array, ink: str) -> None:
    """Lay a colour over the picture, as thickly as ``where`` ``(H, W)`` in [0, 1] says."""
    picture += where.clip(0, 1)[..., None] * (colour(ink) - picture)


def edge(inside: Array, soft: float = 0.012) -> Array:
    """1 where ``inside`` is positive, with a soft edge."""
    return (0.5 + inside / soft).clip(0, 1)


def feathers(picture: Array, where: Array, p: Array, count: int, height: float, inks: list[str]) -> None:
    """Rows of round feathers that overlap as tiles do, each with a quill, barbs and a rim of ink; its colour is chance."""
    rng = np.random.default_rng(count)
    row, u = np.divmod((1.2 - p[..., 1]) / height, 1)
    rows = row.astype(int)

    def column(n: NDArray[np.int_]) -> tuple[NDArray[np.int_], Array]:
        place, across = np.divmod(np.arctan2(p[..., 0], p[..., 2]) / (2 * np.pi) * count + 0.5 * (n % 2), 1)
        return place.astype(int) % count, 2 * across - 1

    (above, s_above), (below, s_below) = column(rows - 1), column(rows)
    tip = np.hypot(s_above, u / 0.7)  # 1 on the rim of the feather that hangs down from the row above
    over = tip < 1
    s, v = np.where(over, s_above, s_below), np.where(over, (u + 1) / 1.7, u / 1.7)
    chosen = rng.integers(len(inks), size=(60, count))[
        np.where(over, rows - 1, rows), np.where(over, above, below)
    ]
    for n, ink in enumerate(inks):
        put(picture, where * (chosen == n), ink)
    put(picture, where * 0.35 * (np.sin(26 * v + 7 * np.abs(s)) > 0.55), INK)
    put(picture, where * 0.6 * edge(0.07 - np.abs(s), 0.06) * (v > 0.45), CREAM)
    put(picture, where * edge(0.13 - np.abs(tip - 0.93), 0.08), INK)


def face(picture: Array, p: Array, front: Array) -> None:
    """Rings of fine strokes around the eyes."""
    for side in (-1, 1):
        dx, dy = p[..., 0] - side * 0.19, p[..., 1] - 0.52
        away, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
        put(picture, front * edge(0.25 - away), CREAM)
        strokes = edge(np.sin(34 * angle + 3 * np.sin(5 * angle)) - 0.2, 0.5)
        put(picture, front * strokes * edge(0.24 - away) * edge(away - 0.15), RUST)
        put(picture, front * edge(0.016 - np.abs(away - 0.25)), INK)
        put(picture, front * edge(0.15 - away), INK)
        put(picture, front * edge(0.125 - away), MUSTARD)
        put(picture, front * edge(0.125 - away) * 0.5 * edge(np.sin(23 * angle) - 0.3, 0.6), RUST)
        put(picture, front * edge(0.07 - away), "#120c09")
        put(picture, front * edge(0.022 - np.hypot(dx + 0.025, dy - 0.035)), "#ffffff")


def lettering(around: Array, share: Array) -> Array:
    """Words once around, as a mask; ``share`` is 0 at their foot and 1 at their head."""
    strip = Image.new("L", (3072, 96))
    words = "hoo goes there?  *  No. 42  *  turned once around  *  an owl of clay  *  "
    font = ImageFont.load_default(76)
    scale = strip.width / ImageDraw.Draw(strip).textlength(words, font)
    ImageDraw.Draw(strip).text((0, 48), words, 255, ImageFont.load_default(76 * scale), anchor="lm")
    at = [(1 - share) * 95, (around / (2 * np.pi) + 0.5) * (strip.width - 1)]
    return map_coordinates(np.asarray(strip, np.float64) / 255, at, order=1, cval=0.0)


def glaze(points: Array) -> Image.Image:
    """The texture ``(TEXELS, 2 TEXELS)`` of `surface`'s points."""
    at = np.meshgrid(
        (np.arange(TEXELS) + 0.5) / TEXELS * ROWS,
        (np.arange(2 * TEXELS) + 0.5) / (2 * TEXELS) * COLUMNS,
        indexing="ij",
    )
    p = np.stack([map_coordinates(points[..., k], at, order=1) for k in range(3)], -1)
    found = parts(p)
    kind = np.array([one[0] for one in found])[np.argmin([one[2] for one in found], 0)]
    is_ = [cv2.GaussianBlur((kind == n).astype(np.float64), (0, 0), 1.5) for n in range(7)]
    picture = np.tile(colour(CREAM), (*kind.shape, 1))
    feathers(picture, is_[BODY], p, 22, 0.15, [TEAL, "#2f7279", RUST, "#8a3a1c", TEAL, "#3c4f36"])
    belly = edge(0.40 - np.abs(p[..., 0]) - 0.25 * (p[..., 1] + 0.2) ** 2, 0.03) * (p[..., 2] > 0)
    feathers(picture, is_[BODY] * belly, p, 26, 0.12, [CREAM, "#f6ecd6", "#e3c78f", "#efb46a"])
    feathers(picture, is_[HEAD], p, 34, 0.085, [RUST, "#8a3a1c", "#c0672f", MUSTARD, "#6f2f18"])
    feathers(picture, is_[WING], p, 30, 0.19, [TEAL, MUSTARD, "#17434c", "#3f8489", RUST])
    face(picture, p, edge(p[..., 2] - 0.2) * (is_[HEAD] + is_[EYE] + is_[BEAK]).clip(0, 1))
    put(picture, is_[BEAK], "#3a2a20")
    put(picture, is_[CLAW], MUSTARD)
    put(picture, is_[CLAW] * edge(np.sin(75 * p[..., 0]) - 0.6, 0.4), INK)
    put(picture, is_[BASE], "#4a2c1a")
    put(picture, is_[BASE] * lettering(np.arctan2(p[..., 0], p[..., 2]), (p[..., 1] + 0.985) / 0.12), CREAM)
    rng = np.random.default_rng(3)
    spots = p.reshape(-1, 3)[rng.choice(kind.size, 1500)]
    away, nearest = cKDTree(spots).query(p.reshape(-1, 3))
    size = rng.uniform(0.003, 0.012, len(spots))[nearest]
    put(picture, 0.75 * edge((size - away).reshape(kind.shape), 0.006), INK)
    return Image.fromarray(picture.round().clip(0, 255).astype(np.uint8))


def owl() -> trimesh.Trimesh:
    """The painted owl, in metres."""
    points = surface()
    n = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = n[:-1, :-1].ravel(), n[1:, :-1].ravel(), n[1:, 1:].ravel(), n[:-1, 1:].ravel()
    v, u = np.meshgrid(np.linspace(1, 0, ROWS + 1), np.linspace(0, 1, COLUMNS + 1), indexing="ij")
    uv = np.stack([u, v], -1).reshape(-1, 2)
    visual = trimesh.visual.TextureVisuals(uv, image=glaze(points))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return trimesh.Trimesh(METRES * points.reshape(-1, 3), faces, visual=visual, process=False)


# The place: lengths in radii of the owl.


def planks(rng: np.random.Generator) -> NDArray[np.uint8]:
    """The table's top, square."""
    picture = Image.new("RGB", (1024, 1024))
    pen = ImageDraw.Draw(picture)
    for y in range(0, 1024, 146):
        base = np.array([150, 108, 70]) + rng.integers(-14, 14)
        pen.rectangle([0, y, 1024, y + 146], fill=tuple(base.tolist()))
        for _ in range(90):
            x, at = rng.uniform(-200, 1024), y + rng.uniform(2, 144)
            ink = tuple((base - rng.integers(4, 34)).tolist())
            pen.line(
                [(x, at), (x + rng.uniform(80, 500), at + rng.uniform(-5, 5))],
                fill=ink,
                width=int(rng.integers(1, 4)),
            )
        pen.line([(0, y), (1024, y)], fill="#3c2817", width=4)
    return cv2.GaussianBlur(np.asarray(picture), (0, 0), 1.2)


def wall(rng: np.random.Generator) -> NDArray[np.uint8]:
    """A shelf with books and a jar before a wall, out of focus; 100 pixels a radius, 16 x 8 of them."""
    picture = Image.new("RGB", (1600, 800), "#c9c2b2")
    pen = ImageDraw.Draw(picture)
    pen.rectangle([560, 130, 760, 330], fill="#5d4632")
    pen.rectangle([576, 146, 744, 314], fill="#e6dfcd")
    pen.ellipse([610, 180, 710, 280], fill="#7c9a8e")
    pen.rectangle([0, 610, 1600, 634], fill="#6a4c33")
    x = 120.0
    while x < 1500:
        if 940 < x < 960:
            x = 1010.0
        wide, tall = rng.uniform(22, 58), rng.uniform(130, 210)
        ink = np.array([[120, 62, 50], [60, 84, 96], [150, 128, 88], [84, 98, 74], [188, 176, 152]])[
            rng.integers(5)
        ]
        pen.rectangle([x, 610 - tall, x + wide, 609], fill=tuple((ink + rng.integers(-18, 18, 3)).tolist()))
        pen.rectangle([x + 5, 610 - 0.85 * tall, x + wide - 5, 610 - 0.75 * tall], fill="#d8ccb0")
        x += wide + float(rng.choice([1.0, 2.0, 30.0]))
    blurred = cv2.GaussianBlur(np.asarray(picture).astype(np.float32), (0, 0), 9)
    shade = np.linspace(1.08, 0.8, 1600)[None, :, None] * np.linspace(1.0, 0.86, 800)[:, None, None]
    return (blurred * shade).clip(0, 255).astype(np.uint8)


def place(scene: Scene, T_cam_room: Array) -> Room:
    """The table with a turntable on it, and the wall behind."""
    r = scene.solid.radius
    top = scene.solid.vertices[:, 1].min() / r
    disc = trimesh.creation.cylinder(0.80, 0.06, sections=128)
    disc.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    disc.apply_translation((0, top - 0.032, 0))
    table = trimesh.creation.box((7, 0.1, 4.0))
    table.apply_translation((0, top - 0.112, 0.2))
    both = [table, disc]
    furniture = trimesh.Trimesh(
        np.concatenate([r * one.vertices for one in both]),
        np.concatenate([table.faces, disc.faces + len(table.vertices)]),
        process=False,
    )
    uvs = furniture.vertices[:, [0, 2]] / (7 * r) + 0.5
    looks = np.repeat([6, 7], [len(one.faces) for one in both])
    rng = np.random.default_rng(12)
    pale = np.full((64, 64, 3), (214, 209, 200), np.uint8)
    plain = np.full((64, 64, 3), (176, 168, 152), np.uint8)
    pictures = [plain, plain, plain, plain, wall(rng), plain, planks(rng), pale]
    T_obj_room = np.linalg.inv(scene.T_cam_obj[0]) @ T_cam_room
    textures = [pyramid(linear(one)) for one in pictures]
    density = np.where(looks == 6, 1024, 64) / (7 * r)
    low, high = r * np.array([-8, -4.2, -5.5]), r * np.array([8, 3.8, 8])
    return Room(T_obj_room, low, high, Surface.of(furniture), uvs, looks, density, textures)


def around_it(scene: Scene, T_cam_room: Array) -> NDArray[np.float32]:
    """Linear light of the place without the owl ``(H, W, 3)``, its soft shadow the mean over the turn."""
    spec, poses = scene.spec, scene.T_cam_obj
    room = place(scene, T_cam_room)
    lamp = lamp_at(spec, 0, poses[0, :3, 3], scene.solid.radius)
    width, height = spec.size
    rows, columns = (one.ravel() for one in np.mgrid[:height, :width])
    light, rng = np.zeros((height * width, 3)), np.random.default_rng(5)
    for n, source in enumerate(lamp.points(LIGHTS)):
        T = poses[n * 37 % len(poses)]
        now = replace(room, T_obj_room=np.linalg.inv(T) @ T_cam_room)
        dx, dy = rng.uniform(-0.5, 0.5, 2)
        light += room_light(scene, now, T, columns + dx, rows + dy, lamp, source)[0]
    return (light / LIGHTS).reshape(height, width, 3).astype(np.float32)


def filmed(mesh: Path, frames: int, size: tuple[int, int]) -> Scene:
    """The owl on its way once around, before the place."""
    effects = Disturbances(noise=0.12, jpeg=0.25, highlights=0.12)
    scene = make_scene(
        SequenceSpec(
            object=str(mesh),
            motion="turntable",
            frames=frames,
            size=size,
            fill=0.8,
            lamp=(-0.75, -0.75, -0.5),
            disturbances=effects,
        )
    )
    times = np.arange(frames + 1.0)
    turn = 2 * np.pi * times / frames
    turn += 0.05 * np.sin(2 * turn) - 0.5  # as a hand turns it; it begins a little aside
    upright = Rotation.from_euler("x", TILT, degrees=True) * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    stays = np.tile(scene.path.positions.mean(0) * (0, 0, 1), (frames + 1, 1))
    scene = replace(
        scene, path=Motion(times, upright * Rotation.from_rotvec(turn[:, None] * (0, 1, 0)), stays)
    )
    T_cam_room = np.eye(4)
    T_cam_room[:3, :3], T_cam_room[:3, 3] = upright.as_matrix(), stays[0]
    return replace(scene, background=around_it(scene, T_cam_room))


def main() -> None:
    """Write the clip, or say where the owl is in its first frame."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--size", type=int, nargs=2, default=(640, 480))
    parser.add_argument(
        "--box", action="store_true", help="print the box of the first frame and make nothing"
    )
    given = parser.parse_args()
    if given.box:
        print(*json.loads((given.folder / "init.json").read_text())["bbox_xywh"], sep=",")
        return
    given.folder.mkdir(parents=True, exist_ok=True)
    mesh = given.folder / "mesh.obj"
    owl().export(mesh)
    scene = filmed(mesh, given.frames, tuple(given.size))
    frames = [render_frame(scene, n) for n in range(given.frames)]
    images = [
        cv2.imdecode(np.frombuffer(compressed(one.image, scene.spec.disturbances.jpeg), np.uint8), 1)
        for one in frames
    ]
    write_clip(
        given.folder,
        np.stack(images)[..., ::-1],
        np.stack([one.mask for one in frames]),
        scene.T_cam_obj,
        scene.camera,
        source="docs/images/owl.py",
        note="synthetic; a painted owl on a turntable before a still camera",
    )


if __name__ == "__main__":
    main()
