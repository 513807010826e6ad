"""Makes a painted clay owl: the object in the README's picture, which `owl_clip.py` films.

The shape is a smooth union of ellipsoids and cones, sampled as one radius for each direction from its middle. The
texture is painted on that sphere of directions.

$ python docs/images/owl.py owl.glb
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

METRES = 0.08
"""Half of the owl's height."""
ROWS, COLUMNS = 160, 320
TEXELS = 1024
"""Rows of the texture, from the top of the sphere of directions to the bottom; it has twice as many columns."""
CREAM, RUST, TEAL, MUSTARD, INK = "#f0dcab", "#a8481f", "#1d5560", "#d79a2b", "#2a1c14"
BODY, HEAD, WING, CLAW, BEAK, EYE, BASE = range(7)


# The shape: signed distances, negative inside; x to the owl's left, y up, z to where it looks.


def ellipsoid(p: Array, centre: tuple[float, ...], radii: tuple[float, ...], turn: float = 0.0) -> Array:
    """Approximate signed distance to an ellipsoid, rotated about z."""
    c, s = np.cos(turn), np.sin(turn)
    q = (p - centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    scaled = np.linalg.norm(q / radii, axis=-1)
    return scaled * (scaled - 1) / np.linalg.norm(q / np.square(radii), axis=-1).clip(1e-9)


def cone(p: Array, foot: tuple[float, ...], tip: tuple[float, ...], thick: float, thin: float) -> Array:
    """Signed distance to a round cone."""
    a, ab = np.array(foot), np.subtract(tip, foot)
    t = ((p - a) @ ab / (ab @ ab)).clip(0, 1)
    return np.linalg.norm(p - a - t[..., None] * ab, axis=-1) - thick - (thin - thick) * t


def base(p: Array) -> Array:
    """Signed distance to a disc with a rounded edge."""
    d = np.stack([np.hypot(p[..., 0], p[..., 2]) - 0.50, np.abs(p[..., 1] + 0.92) - 0.05], -1)
    return np.linalg.norm(d.clip(0), axis=-1) + d.max(-1).clip(max=0) - 0.03


def owl_parts(p: Array) -> list[tuple[int, float, Array]]:
    """What each part is painted as, how softly it blends into the others, and its signed distances."""
    found = [
        (BODY, 0.10, ellipsoid(p, (0, -0.30, 0), (0.59, 0.76, 0.54))),
        (HEAD, 0.10, ellipsoid(p, (0, 0.46, 0.05), (0.50, 0.38, 0.43))),
        (BODY, 0.10, cone(p, (0, -0.35, -0.36), (0, -0.72, -0.54), 0.20, 0.12)),
        (BEAK, 0.03, cone(p, (0, 0.47, 0.46), (0, 0.33, 0.58), 0.09, 0.025)),
        (BASE, 0.06, base(p)),
    ]
    for side in (-1, 1):
        found += [
            (HEAD, 0.08, cone(p, (side * 0.25, 0.68, 0.05), (side * 0.40, 0.96, 0.0), 0.16, 0.05)),
            (EYE, 0.03, ellipsoid(p, (side * 0.19, 0.52, 0.38), (0.15, 0.15, 0.10))),
            (WING, 0.04, ellipsoid(p, (side * 0.52, -0.22, -0.05), (0.13, 0.50, 0.38), side * 0.14)),
            (CLAW, 0.03, ellipsoid(p, (side * 0.19, -0.80, 0.36), (0.13, 0.10, 0.16))),
        ]
    return found


def owl_distance(p: Array) -> Array:
    """Signed distance to the owl: the quadratic smooth minimum of its parts."""
    (_, _, joined), *others = owl_parts(p)
    for _, softness, other in others:
        meet = (0.5 + 0.5 * (other - joined) / softness).clip(0, 1)
        joined = other + (joined - other) * meet - softness * meet * (1 - meet)
    return joined


def trace_surface() -> Array:
    """``(ROWS + 1, COLUMNS + 1, 3)`` points in all directions from the middle, found by sphere tracing from outside."""
    polar, around = np.meshgrid(
        np.linspace(1e-3, np.pi - 1e-3, ROWS + 1), np.linspace(-np.pi, np.pi, COLUMNS + 1), indexing="ij"
    )
    towards = np.stack(
        [np.sin(polar) * np.sin(around), np.cos(polar), np.sin(polar) * np.cos(around)], axis=-1
    )
    away = np.full(polar.shape, 1.6)
    for _ in range(120):
        away = (away - 0.6 * owl_distance(away[..., None] * towards)).clip(0.05)
    return away[..., None] * towards


# The texture.


def colour(name: str) -> Array:
    """``(3,)`` in [0, 255]."""
    return np.array([int(name[n : n + 2], 16) for n in (1, 3, 5)], np.float64)


def blend(picture: Array, where: Array, ink: str) -> None:
    """Blend a colour into the picture, with the opacity ``where`` ``(H, W)``."""
    picture += where.clip(0, 1)[..., None] * (colour(ink) - picture)


def edge(inside: Array, soft: float = 0.012) -> Array:
    """1 where ``inside`` is positive, with a soft edge."""
    return (0.5 + inside / soft).clip(0, 1)


def paint_feathers(
    picture: Array, where: Array, p: Array, count: int, height: float, inks: list[str]
) -> None:
    """Paint rows of round feathers that overlap like tiles, each with a quill, barbs, a rim and a random ink."""
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
        blend(picture, where * (chosen == n), ink)
    blend(picture, where * 0.35 * (np.sin(26 * v + 7 * np.abs(s)) > 0.55), INK)
    blend(picture, where * 0.6 * edge(0.07 - np.abs(s), 0.06) * (v > 0.45), CREAM)
    blend(picture, where * edge(0.13 - np.abs(tip - 0.93), 0.08), INK)


def paint_face(picture: Array, p: Array, front: Array) -> None:
    """Paint the eyes and rings of fine strokes around them."""
    for side in (-1, 1):
        dx, dy = p[..., 0] - side * 0.19, p[..., 1] - 0.52
        away, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
        blend(picture, front * edge(0.25 - away), CREAM)
        strokes = edge(np.sin(34 * angle + 3 * np.sin(5 * angle)) - 0.2, 0.5)
        blend(picture, front * strokes * edge(0.24 - away) * edge(away - 0.15), RUST)
        blend(picture, front * edge(0.016 - np.abs(away - 0.25)), INK)
        blend(picture, front * edge(0.15 - away), INK)
        blend(picture, front * edge(0.125 - away), MUSTARD)
        blend(picture, front * edge(0.125 - away) * 0.5 * edge(np.sin(23 * angle) - 0.3, 0.6), RUST)
        blend(picture, front * edge(0.07 - away), "#120c09")
        blend(picture, front * edge(0.022 - np.hypot(dx + 0.025, dy - 0.035)), "#ffffff")


def draw_lettering(around: Array, height: Array) -> Array:
    """Opacity of the words around the base; ``height`` is 0 at the foot of the letters and 1 at their top."""
    strip = Image.new("L", (3072, 96))
    words = "hoo goes there?  *  No. 42  *  turned once around  *  an owl of clay  *  "
    font = ImageFont.load_default(76)
    scale = strip.width / ImageDraw.Draw(strip).textlength(words, font)
    ImageDraw.Draw(strip).text((0, 48), words, 255, ImageFont.load_default(76 * scale), anchor="lm")
    at = [(1 - height) * 95, (around / (2 * np.pi) + 0.5) * (strip.width - 1)]
    return map_coordinates(np.asarray(strip, np.float64) / 255, at, order=1, cval=0.0)


def paint_texture(points: Array) -> Image.Image:
    """The texture ``(TEXELS, 2 TEXELS)`` of `trace_surface`'s points."""
    at = np.meshgrid(
        (np.arange(TEXELS) + 0.5) / TEXELS * ROWS,
        (np.arange(2 * TEXELS) + 0.5) / (2 * TEXELS) * COLUMNS,
        indexing="ij",
    )
    p = np.stack([map_coordinates(points[..., k], at, order=1) for k in range(3)], -1)
    found = owl_parts(p)
    kind = np.array([one[0] for one in found])[np.argmin([one[2] for one in found], 0)]
    share = [cv2.GaussianBlur((kind == n).astype(np.float64), (0, 0), 1.5) for n in range(7)]
    picture = np.tile(colour(CREAM), (*kind.shape, 1))
    paint_feathers(picture, share[BODY], p, 22, 0.15, [TEAL, "#2f7279", RUST, "#8a3a1c", TEAL, "#3c4f36"])
    belly = edge(0.40 - np.abs(p[..., 0]) - 0.25 * (p[..., 1] + 0.2) ** 2, 0.03) * (p[..., 2] > 0)
    paint_feathers(picture, share[BODY] * belly, p, 26, 0.12, [CREAM, "#f4e4ba", "#e0b466", "#eaa04e"])
    paint_feathers(picture, share[HEAD], p, 34, 0.085, [RUST, "#8a3a1c", "#c0672f", MUSTARD, "#6f2f18"])
    paint_feathers(picture, share[WING], p, 30, 0.19, [TEAL, MUSTARD, "#17434c", "#3f8489", RUST])
    paint_face(picture, p, edge(p[..., 2] - 0.2) * (share[HEAD] + share[EYE] + share[BEAK]).clip(0, 1))
    blend(picture, share[BEAK], "#cf8a1f")
    blend(picture, share[CLAW], MUSTARD)
    blend(picture, share[CLAW] * edge(np.sin(75 * p[..., 0]) - 0.6, 0.4), INK)
    blend(picture, share[BASE], "#a8431c")
    blend(
        picture,
        share[BASE] * draw_lettering(np.arctan2(p[..., 0], p[..., 2]), (p[..., 1] + 0.985) / 0.12),
        CREAM,
    )
    rng = np.random.default_rng(3)
    spots = p.reshape(-1, 3)[rng.choice(kind.size, 1500)]
    away, nearest = cKDTree(spots).query(p.reshape(-1, 3))
    size = rng.uniform(0.003, 0.012, len(spots))[nearest]
    blend(picture, 0.75 * edge((size - away).reshape(kind.shape), 0.006), INK)
    return Image.fromarray(picture.round().clip(0, 255).astype(np.uint8))


def build_owl() -> trimesh.Trimesh:
    """The painted owl, in metres."""
    points = trace_surface()
    n = np.arange(points[..., 0].size).reshape(points.shape[:2])
    a, b, c, d = n[:-1, :-1].ravel(), n[1:, :-1].ravel(), n[1:, 1:].ravel(), n[:-1, 1:].ravel()
    v, u = np.meshgrid(np.linspace(1, 0, ROWS + 1), np.linspace(0, 1, COLUMNS + 1), indexing="ij")
    uv = np.stack([u, v], -1).reshape(-1, 2)
    visual = trimesh.visual.TextureVisuals(uv, image=paint_texture(points))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return trimesh.Trimesh(METRES * points.reshape(-1, 3), faces, visual=visual, process=False)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("mesh", type=Path, help="the file to write, in any format of trimesh")
    build_owl().export(parser.parse_args().mesh)
