"""Painted textures: panels for objects and a cluttered background, all from a seed."""

from __future__ import annotations

import colorsys

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image

FloatImage = NDArray[np.float32]
"""``(H, W, 3)`` float32 RGB in [0, 255]."""

PALETTE = ((0.0, 0.85), (0.45, 0.7), (0.58, 0.3), (0.12, 0.95), (0.8, 0.45))
"""Hue shift and value of a panel's ground, stripes and three colours of marks."""

GLYPHS = "ABCDEFGHKLMNPRSTUVWXYZ23456789&?#"


def paint_panel(rng: np.random.Generator, size: int = 256) -> FloatImage:
    """A printed panel ``(size, size, 3)``: stripes, discs, rings and glyphs in strong colours, and grain."""
    fine = 2 * size  # drawn at twice the size and averaged: an antialiased print
    hue = rng.random()
    palette = [_colour(hue + shift, 0.55 + 0.4 * rng.random(), value) for shift, value in PALETTE]
    panel = np.full((fine, fine, 3), palette[0], np.uint8)
    _draw_stripes(panel, palette[1], rng)
    for _ in range(80):
        centre = rng.integers(0, fine, 2)
        _draw_mark(panel, centre, int(rng.integers(fine // 40, fine // 11)), palette[rng.integers(1, 5)], rng)
    panel_float = cv2.resize(panel, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.clip(panel_float + 7 * _smooth_noise(rng, (size, size), 1.5)[..., None], 0, 255)


def paint_plain(rng: np.random.Generator, size: int, hue: float) -> FloatImage:
    """A panel ``(size, size, 3)`` of one colour, with spots so faint that nothing can be matched by them."""
    spots = 1.5 * _smooth_noise(rng, (size, size), size / 16)
    return np.clip(np.array(plain_colour(hue), np.float32) + spots[..., None], 0, 255)


def paint_bands(rng: np.random.Generator, size: int) -> FloatImage:
    """A panel ``(size, size, 3)`` of level bands in strong colours: every row is of one colour."""
    hue = rng.random()
    palette = [_colour(hue + shift, 0.55 + 0.4 * rng.random(), value) for shift, value in PALETTE]
    edges = np.cumsum(rng.uniform(0.02, 0.08, 50)) * size
    band = np.searchsorted(edges, (np.arange(4 * size) + 0.5) / 4)  # four samples a row: an antialiased print
    colours = np.array(palette, np.float32)[rng.integers(0, len(palette), 51)][band]
    rows = colours.reshape(size, 4, 3).mean(1)
    return np.repeat(rows[:, None], size, axis=1)


def plain_colour(hue: float) -> tuple[int, int, int]:
    """The colour of textureless objects of a ``hue`` in [0, 1)."""
    return _colour(hue, 0.4, 0.72)


def paint_background(rng: np.random.Generator, width: int, height: int, clutter: float = 1.0) -> FloatImage:
    """A soft gradient ``(height, width, 3)`` with dull things on it, many at ``clutter`` 1, none at 0."""
    ramp = np.linspace(0, 1, height)[:, None, None]
    top, bottom = (np.array(_colour(rng.random(), 0.15, value)) for value in (0.75, 0.45))
    canvas: Image = np.repeat(top + ramp * (bottom - top), width, axis=1).astype(np.uint8)
    for _ in range(round(70 * clutter)):
        colour = _colour(rng.random(), 0.4 * rng.random(), 0.2 + 0.6 * rng.random())
        centre = rng.integers(0, (width, height))
        _draw_mark(canvas, centre, int(rng.integers(height // 30 + 1, height // 7 + 2)), colour, rng)
    blurred = cv2.GaussianBlur(canvas.astype(np.float32), (0, 0), 0.8)
    grain = 8 * clutter * _smooth_noise(rng, (height, width), 1.2)
    return np.clip(blurred + grain[..., None], 0, 255)


def sample_panels(panels: FloatImage, panel: NDArray[np.int64], uv: NDArray[np.float64]) -> FloatImage:
    """Bilinear colours ``(N, 3)``.

    Args:
        panels: ``(P, S, S, 3)``.
        panel: ``(N,)`` which panel.
        uv: ``(N, 2)`` where in it; [0, 1] spans the panel, and what is beyond takes the edge's colour.
    """
    size = panels.shape[1]
    x, y = np.clip(uv * size - 0.5, 0, size - 1.001).T
    column, row = x.astype(np.int64), y.astype(np.int64)
    right, below = (x - column)[:, None], (y - row)[:, None]
    upper = panels[panel, row, column] * (1 - right) + panels[panel, row, column + 1] * right
    lower = panels[panel, row + 1, column] * (1 - right) + panels[panel, row + 1, column + 1] * right
    return (upper * (1 - below) + lower * below).astype(np.float32)


def _colour(hue: float, saturation: float, value: float) -> tuple[int, int, int]:
    red, green, blue = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def _draw_stripes(canvas: Image, colour: tuple[int, int, int], rng: np.random.Generator) -> None:
    """Oblique stripes over a part of the canvas, irregular so that they do not look alike when shifted."""
    size = canvas.shape[0]
    angle = rng.uniform(0, np.pi)
    x = np.arange(size) - size / 2
    y = x[:, None]
    along = np.cos(angle) * x + np.sin(angle) * y
    across = -np.sin(angle) * x + np.cos(angle) * y
    edges = np.cumsum(rng.uniform(0.02, 0.09, 40)) * size - 0.75 * size
    canvas[(np.searchsorted(edges, along) % 2 == 1) & (across > rng.uniform(-0.3, 0.2) * size)] = colour


def _draw_mark(
    canvas: Image,
    centre: NDArray[np.int64],
    radius: int,
    colour: tuple[int, int, int],
    rng: np.random.Generator,
) -> None:
    """One disc, ring, rotated rectangle or glyph."""
    x, y = int(centre[0]), int(centre[1])
    kind, angle = rng.integers(4), rng.uniform(0, 180)
    if kind == 0:
        cv2.circle(canvas, (x, y), radius, colour, -1, cv2.LINE_AA)
    elif kind == 1:
        cv2.ellipse(
            canvas, (x, y), (radius, radius // 2 + 1), angle, 0, 360, colour, radius // 4 + 1, cv2.LINE_AA
        )
    elif kind == 2:
        corners = cv2.boxPoints(((x, y), (2 * radius, radius * rng.uniform(0.4, 1.6)), angle))
        cv2.fillConvexPoly(canvas, corners.round().astype(np.int32), colour, cv2.LINE_AA)
    else:
        glyph = GLYPHS[rng.integers(len(GLYPHS))]
        origin = (x - radius, y + radius)
        font = cv2.FONT_HERSHEY_DUPLEX
        cv2.putText(canvas, glyph, origin, font, radius / 10, colour, radius // 6 + 1, cv2.LINE_AA)


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, int], sigma: float) -> FloatImage:
    """Gaussian noise ``shape`` of unit variance, correlated over ``sigma`` pixels."""
    noise = cv2.GaussianBlur(rng.standard_normal(shape, dtype=np.float32), (0, 0), sigma)
    return noise / noise.std()
