"""Warps one view into another, pixel by pixel; `tracking3d.points.warping` says what is computed."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32, float64, int64, void
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, REORDER, kernel, record


class WarpTarget(NamedTuple):
    """The view that is written.

    Attributes:
        inverse_depth, beyond, intrinsics: See `tracking3d.scene.surface.Drawn`.
        reach: Pixels beyond its outline up to which there is something.
    """

    inverse_depth: NDArray[np.float32]
    beyond: NDArray[np.float32]
    intrinsics: NDArray[np.float64]
    reach: float


class WarpSource(NamedTuple):
    """The other view; see `tracking3d.scene.surface.Drawn`."""

    intrinsics: NDArray[np.float64]
    image: NDArray[np.float32]
    mask: NDArray[np.float32]
    inverse_depth: NDArray[np.float32]


_TARGET = record(WarpTarget, float32[:, ::1], float32[:, ::1], float64[::1], float64)
_SOURCE = record(WarpSource, float64[::1], float32[:, ::1], float32[:, ::1], float32[:, ::1])

_inner = numba.njit(inline="always", fastmath=REORDER, **OPTIONS)


@numba.njit(inline="always", **OPTIONS)
def _between(plane: NDArray[Any], row: int, column: int, down: float, right: float) -> Any:
    """Between pixels, 0 beyond the border."""
    height, width = plane.shape
    value = 0.0
    for i in range(2):
        for j in range(2):
            if 0 <= row + i < height and 0 <= column + j < width:
                share = (right if j else 1 - right) * (down if i else 1 - down)
                value += share * plane[row + i, column + j]
    return value


@kernel(
    void(_TARGET, _SOURCE, float64[:, ::1], float64, float64, float32[:, ::1], float32[:, ::1], int64, int64),
    fastmath=REORDER,
)
def warp(
    target: WarpTarget,
    source: WarpSource,
    T_source_target: NDArray[Any],
    nearest: float,
    tolerance: float,
    warped: NDArray[Any],
    known: NDArray[Any],
    first: int,
    last: int,
) -> None:
    """Fill rows ``first`` to before ``last`` of ``warped`` and ``known``, both ``(h, w)``.

    Args:
        target: The view that is written.
        source: The other view.
        T_source_target: ``(4, 4)`` from its camera coordinates to the other view's.
        nearest: Depth from which on points have an image.
        tolerance: How far behind the other view's surface a point may lie and be seen, in object units.
        warped, known: What the other view shows, and how much of it is known.
        first, last: Rows.
    """
    inverse_depth, beyond, intrinsics, reach = target
    source_intrinsics, source_image, source_mask, source_inverse_depth = source
    height, width = source_image.shape
    P, q = np.empty((3, 3)), np.empty(3)
    _write_projection(T_source_target, intrinsics, source_intrinsics, P, q)
    for y in range(first, last):
        row_x = P[0, 1] * y + P[0, 2]
        row_y = P[1, 1] * y + P[1, 2]
        row_z = P[2, 1] * y + P[2, 2]
        for x in range(inverse_depth.shape[1]):
            warped[y, x] = known[y, x] = 0.0
            near = np.float64(inverse_depth[y, x])
            if not (beyond[y, x] < reach and near > 0):
                continue
            z = P[2, 0] * x + row_z + near * q[2]  # over the depth in the view that is written
            if not z > nearest * near:
                continue
            over = 1 / z
            u = (P[0, 0] * x + row_x + near * q[0]) * over
            v = (P[1, 0] * x + row_y + near * q[1]) * over
            if not (-1 < u < width and -1 < v < height):
                continue
            # Counted from one pixel further, cutting off the fraction is rounding down.
            column, row = int(u + 1) - 1, int(v + 1) - 1
            right, down = u - column, v - row
            if column >= 0 and row >= 0 and column + 1 < width and row + 1 < height:
                a, b = (1 - right) * (1 - down), right * (1 - down)
                c, d = (1 - right) * down, right * down
                warped[y, x] = _mixed(source_image, row, column, a, b, c, d)
                drawn = _mixed(source_inverse_depth, row, column, a, b, c, d)
                if drawn > 0 and z * drawn < near * (1 + tolerance * drawn):
                    known[y, x] = _mixed(source_mask, row, column, a, b, c, d)
            else:
                warped[y, x] = _between(source_image, row, column, down, right)
                drawn = _between(source_inverse_depth, row, column, down, right)
                if drawn > 0 and z * drawn < near * (1 + tolerance * drawn):
                    known[y, x] = _between(source_mask, row, column, down, right)


@_inner
def _write_projection(T, intrinsics, source_intrinsics, P, q):
    """Homogeneous pixels of the other view are ``P (x, y, 1) + q / depth``: a row has much in common."""
    fx, fy, cx, cy = intrinsics
    for j in range(4):
        across, along, ahead = T[0, j], T[1, j], T[2, j]
        across = source_intrinsics[0] * across + source_intrinsics[2] * ahead
        along = source_intrinsics[1] * along + source_intrinsics[3] * ahead
        if j < 3:
            P[0, j], P[1, j], P[2, j] = across, along, ahead
        else:
            q[0], q[1], q[2] = across, along, ahead
    for i in range(3):
        P[i, 2] -= P[i, 0] * cx / fx + P[i, 1] * cy / fy
        P[i, 0] /= fx
        P[i, 1] /= fy


@_inner
def _mixed(plane, row, column, a, b, c, d):
    """Four pixels by their weights."""
    return (
        a * plane[row, column]
        + b * plane[row, column + 1]
        + c * plane[row + 1, column]
        + d * plane[row + 1, column + 1]
    )
