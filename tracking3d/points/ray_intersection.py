"""Intersects the rays through pixels with the mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import NEAR

_EDGE = 1e-9  # barycentric slack, so that a ray through an edge does not slip between two faces
_SLACK = 1e-4  # pixels; more than the barycentric slack is on the screen, on faces up to 100,000 pixels long
_CHUNK = 256  # points compared with the boxes of all faces at once


def surface_under(
    screen: NDArray[np.float64], depth: NDArray[np.float64], faces: NDArray[np.int64], xy: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The nearest front-facing face under each pixel and the perspective-correct weights of its corners.

    Exact between pixel centres, unlike a look into a drawn face buffer.

    Args:
        screen: ``(V, 2)`` projected vertices.
        depth: ``(V,)`` their depths.
        faces: ``(F, 3)``.
        xy: ``(N, 2)`` pixels.

    Returns:
        ``(N,)`` face, -1 where there is none, and ``(N, 3)`` barycentric weights on the surface.
    """
    corner, z = screen[faces], depth[faces]
    ab, ac = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    with np.errstate(invalid="ignore"):
        front = np.nonzero((_cross(ac, ab) > 0) & (z.min(1) > NEAR))[0]  # y points down
    corner, z = corner[front], z[front]
    face = np.full(len(xy), -1, dtype=np.int64)
    barycentric = np.full((len(xy), 3), np.nan)
    point, candidate = _faces_around(corner, xy)
    to_corner = corner[candidate] - xy[point, None]  # (P, 3, 2)
    weight = _cross(np.roll(to_corner, -2, 1), np.roll(to_corner, -1, 1))
    weight = weight / weight.sum(1, keepdims=True)
    weight_by_depth = weight / z[candidate]
    inverse_depth = weight_by_depth.sum(1)
    hit = (weight >= -_EDGE).all(1) & (inverse_depth > 0)
    # The nearest of a point's faces comes first, and of those at one depth the first one.
    order = np.lexsort((candidate, -inverse_depth, point))
    order = order[hit[order]]
    found, first = np.unique(point[order], return_index=True)
    nearest = order[first]
    face[found] = front[candidate[nearest]]
    barycentric[found] = weight_by_depth[nearest] / inverse_depth[nearest, None]
    return face, barycentric


def _faces_around(
    corner: NDArray[np.float64], xy: NDArray[np.float64]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The pairs of a point ``(N, 2)`` and a face ``(F, 3, 2)`` whose box on the screen holds it."""
    low, high = corner.min(1) - _SLACK, corner.max(1) + _SLACK
    points, faces = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
    for start in range(0, len(xy), _CHUNK):
        x, y = xy[start : start + _CHUNK].T[:, :, None]
        inside = (x >= low[:, 0]) & (x <= high[:, 0]) & (y >= low[:, 1]) & (y <= high[:, 1])
        point, face = np.nonzero(inside)
        points.append(start + point)
        faces.append(face)
    return np.concatenate(points), np.concatenate(faces)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """z of the cross product of ``(..., 2)`` vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
