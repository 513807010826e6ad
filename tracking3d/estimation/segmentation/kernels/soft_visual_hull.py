"""Kernels of `tracking3d.estimation.segmentation.soft_visual_hull`: what cells see of a mask, and what rays see of
the hulls."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, kernel

_HULLS = 2
"""As many as `tracking3d.estimation.segmentation.soft_visual_hull` has ranks; loops of a known length are a third
faster."""


def sample_grid_distances(
    distance: NDArray[np.float32],
    unknown: NDArray[np.bool_],
    to_pixels: NDArray[np.float64],
    by_depth: float,
    beyond: float,
    near: float,
    cells: int,
    mark: int,
) -> NDArray[np.int8] | None:
    """``(C * C * C,)``: see `sample_grid_distances` of the caller; ``mark`` is for unknown cells."""
    values = np.empty((cells, cells, cells), np.int8)
    in_front = _carry_sign(
        np.ascontiguousarray(distance, np.float32),
        np.ascontiguousarray(unknown).view(np.uint8),
        np.ascontiguousarray(to_pixels),
        by_depth,
        beyond,
        near,
        mark,
        values,
    )
    return values.reshape(-1) if in_front else None


@numba.njit(inline="always", **OPTIONS)
def _at(plane, row, column, beyond):
    size = len(plane)
    return plane[row, column] if 0 <= row < size and 0 <= column < size else beyond


@kernel(
    "boolean(float32[:,::1], uint8[:,::1], float64[:,::1], float64, float64, float64, int64, int8[:,:,::1])"
)
def _carry_sign(distance, unknown, P, by_depth, beyond, near, mark, values):
    size, cells = len(distance), len(values)
    most = mark - 1
    for z in range(cells):
        for y in range(cells):
            for x in range(cells):
                depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
                if depth <= near:
                    return False
                u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / depth
                v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / depth
                value = beyond
                if -1 < u < size and -1 < v < size:
                    row, column = math.floor(v + 0.5), math.floor(u + 0.5)
                    if 0 <= row < size and 0 <= column < size and unknown[row, column]:
                        values[z, y, x] = mark
                        continue
                    row, column = math.floor(v), math.floor(u)
                    right, down = u - column, v - row
                    upper = (1 - right) * _at(distance, row, column, beyond)
                    upper += right * _at(distance, row, column + 1, beyond)
                    lower = (1 - right) * _at(distance, row + 1, column, beyond)
                    lower += right * _at(distance, row + 1, column + 1, beyond)
                    value = (1 - down) * upper + down * lower
                values[z, y, x] = min(max(np.rint(value * depth * by_depth), -most), most)
    return True


def march_rays(
    hulls: NDArray[np.float32],
    origin: NDArray[np.float32],
    rays: NDArray[np.float32],
    depths: NDArray[np.float32],
    focal: float,
    beyond: float,
) -> NDArray[np.float32]:
    """``(R, S, S)``: see `tracking3d.estimation.segmentation.soft_visual_hull.march_rays`."""
    nearest = np.empty((_HULLS, *rays.shape[:2]), np.float32)
    _march_rays(hulls, origin, rays, depths, focal, beyond, nearest)
    return nearest


@numba.njit(inline="always", **OPTIONS)
def _crossing(origin, along, low, high, enters, leaves):
    """Between which depths a ray is within two planes, as well as between those given."""
    if along == 0:
        return (enters, leaves) if low <= origin <= high else (enters, -np.float32(np.inf))
    a, b = (low - origin) / along, (high - origin) / along
    return max(enters, min(a, b)), min(leaves, max(a, b))


@kernel(
    "void(float32[:,:,:,::1], float32[::1], float32[:,:,::1], float32[::1], float32, float32,"
    " float32[:,:,::1])"
)
def _march_rays(hulls, origin, rays, depths, focal, beyond, nearest):
    cells, count = hulls.shape[0], _HULLS
    low, high, last = np.float32(-0.5), np.float32(cells - 0.5), np.float32(cells - 1)
    end = np.uint32(cells - 2)
    zero, unit = np.float32(0), np.float32(1)
    best = np.empty(count, np.float32)
    for row in range(rays.shape[0]):
        for column in range(rays.shape[1]):
            a, b, c = rays[row, column]
            best[:] = beyond
            enters, leaves = zero, np.float32(np.inf)
            enters, leaves = _crossing(origin[0], a, low, high, enters, leaves)
            enters, leaves = _crossing(origin[1], b, low, high, enters, leaves)
            enters, leaves = _crossing(origin[2], c, low, high, enters, leaves)
            for depth in depths:
                if not enters <= depth <= leaves:
                    continue
                x = min(max(origin[0] + depth * a, zero), last)
                y = min(max(origin[1] + depth * b, zero), last)
                z = min(max(origin[2] + depth * c, zero), last)
                i, j, k = min(np.uint32(x), end), min(np.uint32(y), end), min(np.uint32(z), end)
                by_depth, nearer = focal / depth, False
                for one in range(count):
                    nearer |= hulls[k, j, i, count + one] * by_depth > best[one]
                if not nearer:
                    continue
                x, y, z = x - np.float32(i), y - np.float32(j), z - np.float32(k)
                for one in range(count):
                    value = zero
                    for dz in range(2):
                        wz = z if dz else unit - z
                        for dy in range(2):
                            wy = y if dy else unit - y
                            left, right = hulls[k + dz, j + dy, i, one], hulls[k + dz, j + dy, i + 1, one]
                            value += wz * wy * (left + x * (right - left))
                    best[one] = max(best[one], value * by_depth)
            for one in range(count):
                nearest[one, row, column] = best[one]
