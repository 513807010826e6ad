"""Texture lookup at ray hits."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def bilinear(texture: NDArray[np.float32], uv: Array) -> Array:
    """Colours ``(N, 3)`` of a texture ``(h, w, 3)`` at ``uv`` ``(N, 2)``, v upwards; it repeats beyond its edges."""
    height, width = texture.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, below = (x - column)[:, None], (y - row)[:, None]
    left_, right_ = column % width, (column + 1) % width
    top_, below_ = row % height, (row + 1) % height
    upper = texture[top_, left_] * (1 - right) + texture[top_, right_] * right
    lower = texture[below_, left_] * (1 - right) + texture[below_, right_] * right
    return upper * (1 - below) + lower * below


def pyramid(texture: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """A texture ``(h, w, 3)`` and its halves, down to a side of 8 texels."""
    levels = [texture]
    while min(levels[-1].shape[:2]) >= 16:
        height, width = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA))
    return levels


def filter_texture(levels: list[NDArray[np.float32]], uv: Array, width: Array) -> Array:
    """Colours ``(N, 3)`` of a `pyramid` at ``uv`` ``(N, 2)``.

    Args:
        levels: The pyramid.
        uv: Texture coordinates, v upwards.
        width: ``(N,)`` how many texels of the finest level lie between a ray and its neighbours
            (Williams, Pyramidal parametrics, 1983).
    """
    level = np.log2(width.clip(1)).round().astype(np.int64).clip(0, len(levels) - 1)
    colours = np.empty((len(uv), 3))
    for k in np.unique(level):
        here = level == k
        colours[here] = bilinear(levels[k], uv[here])
    return colours
