"""One view as another one would see it, pixel by pixel; `tracking3d.points.carrying` says what is computed."""

from __future__ import annotations

from math import floor
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, kernel


@numba.njit(inline="always", **OPTIONS)
def _between(plane: NDArray[Any], x: float, y: float) -> Any:
    """Between pixels, 0 beyond the border."""
    row, column = floor(y), floor(x)
    right, down = x - column, y - row
    height, width = plane.shape
    value = 0.0
    for i in range(2):
        for j in range(2):
            if 0 <= row + i < height and 0 <= column + j < width:
                share = (right if j else 1 - right) * (down if i else 1 - down)
                value += share * plane[row + i, column + j]
    return value


@kernel(
    "void(float32[:,::1], float32[:,::1], float64, float64[::1], float64[:,::1], float64[::1], float32[:,::1],"
    " float32[:,::1], float32[:,::1], float64, float64, float32[:,::1], float32[:,::1], int64, int64)"
)
def warp(
    inverse_depth: NDArray[Any],
    beyond: NDArray[Any],
    reach: float,
    intrinsics: NDArray[Any],
    T_source_target: NDArray[Any],
    source_intrinsics: NDArray[Any],
    source_image: NDArray[Any],
    source_mask: NDArray[Any],
    source_inverse_depth: NDArray[Any],
    nearest: float,
    tolerance: float,
    warped: NDArray[Any],
    known: NDArray[Any],
    first: int,
    last: int,
) -> None:
    """Fill rows ``first`` to before ``last`` of ``warped`` and ``known``, both ``(h, w)``.

    Args:
        inverse_depth, beyond, intrinsics: Of the view that is written; see `tracking3d.points.view.View`.
        reach: Pixels beyond its outline up to which there is something.
        T_source_target: ``(4, 4)`` from its camera coordinates to the other view's.
        source_intrinsics, source_image, source_mask, source_inverse_depth: Of the other view.
        nearest: Depth from which on points have an image.
        tolerance: How far behind the other view's surface a point may lie and be seen, in object units.
        warped, known: What the other view shows, and how much of it is known.
        first, last: Rows.
    """
    fx, fy, cx, cy = intrinsics
    source_fx, source_fy, source_cx, source_cy = source_intrinsics
    height, width = source_image.shape
    T, point = T_source_target, np.empty(3)
    for y in range(first, last):
        for x in range(inverse_depth.shape[1]):
            warped[y, x] = known[y, x] = 0.0
            if not (beyond[y, x] < reach and inverse_depth[y, x] > 0):
                continue
            depth = 1 / np.float64(inverse_depth[y, x])
            across, along = (x - cx) / fx * depth, (y - cy) / fy * depth
            for i in range(3):
                point[i] = T[i, 0] * across + T[i, 1] * along + T[i, 2] * depth + T[i, 3]
            if not point[2] > nearest:
                continue
            u = source_fx * point[0] / point[2] + source_cx
            v = source_fy * point[1] / point[2] + source_cy
            if not (-1 < u < width and -1 < v < height):
                continue
            warped[y, x] = _between(source_image, u, v)
            drawn = _between(source_inverse_depth, u, v)
            if drawn > 0 and point[2] < 1 / drawn + tolerance:
                known[y, x] = _between(source_mask, u, v)
