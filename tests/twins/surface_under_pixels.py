"""Intersects the rays through pixels with every face of the mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import NEAR

_EDGE = 1e-9  # barycentric slack, so that a ray through an edge does not slip between two faces
_CHUNK = 256  # points met with all faces at once


def surface_under(
    screen: NDArray[np.float64], depth: NDArray[np.float64], faces: NDArray[np.int64], xy: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """See `tracking3d.points.ray_intersection.surface_under`."""
    corner, z = screen[faces], depth[faces]
    ab, ac = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    with np.errstate(invalid="ignore"):
        front = np.nonzero((_cross(ac, ab) > 0) & (z.min(1) > NEAR))[0]  # y points down
    corner, z = corner[front], z[front]
    face = np.full(len(xy), -1, dtype=np.int64)
    barycentric = np.full((len(xy), 3), np.nan)
    for start in range(0, len(xy) if len(front) else 0, _CHUNK):
        to_corner = corner - xy[start : start + _CHUNK, None, None]  # (n, F, 3, 2)
        weight = _cross(np.roll(to_corner, -2, 2), np.roll(to_corner, -1, 2))
        weight = weight / weight.sum(2, keepdims=True)
        weight_by_depth = weight / z
        inverse_depth = np.where((weight >= -_EDGE).all(2), weight_by_depth.sum(2), 0.0)
        nearest = inverse_depth.argmax(1)
        row = np.arange(len(nearest))
        hit = inverse_depth[row, nearest] > 0
        on_surface = (
            weight_by_depth[row, nearest] / np.where(hit, inverse_depth[row, nearest], np.nan)[:, None]
        )
        face[start : start + _CHUNK] = np.where(hit, front[nearest], -1)
        barycentric[start : start + _CHUNK] = on_surface
    return face, barycentric


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """z of the cross product of ``(..., 2)`` vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
