"""The signed distance of a closed mesh on a grid."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from tracking3d.reconstruction.grid import FloatArray, Grid

_SAMPLES = 20_000
_NEAREST = 2  # samples whose faces are asked for the exact distance
_POINTS_AT_ONCE = 10_000  # so that what trimesh computes with them stays small


def mesh_distance(
    grid: Grid, vertices: NDArray[np.float64], faces: NDArray[np.int64], far: float
) -> FloatArray:
    """``(X * Y * Z,)`` distance from the surface, positive inside, cut off at ``far``.

    Args:
        grid: Where.
        vertices: ``(V, 3)``.
        faces: ``(F, 3)`` counter-clockwise seen from outside.
        far: In the unit of the vertices.
    """
    points = grid.points
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    samples, of_face = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    spread = np.sqrt(mesh.area / _SAMPLES)
    around = np.flatnonzero(_cells_around(grid, samples, far))
    rough, nearest = cKDTree(samples).query(
        points[around], k=_NEAREST, eps=0.1, distance_upper_bound=far + 2 * spread
    )
    distance = np.full(len(points), far)
    found = np.isfinite(rough).all(1)
    around, faces_there = around[found], of_face[nearest[found]]
    for first in range(0, len(around), _POINTS_AT_ONCE):
        some = slice(first, first + _POINTS_AT_ONCE)
        near = points[around[some]]
        corners = mesh.triangles[faces_there[some].ravel()]
        closest = trimesh.triangles.closest_point(corners, np.repeat(near, _NEAREST, axis=0))
        exact = np.linalg.norm(closest.reshape(-1, _NEAREST, 3) - near[:, None], axis=2).min(1)
        distance[around[some]] = np.minimum(exact, far)
    return np.where(inside_mesh(grid, vertices, faces), distance, -distance).astype(np.float32)


def _cells_around(grid: Grid, samples: NDArray[np.float64], far: float) -> NDArray[np.bool_]:
    """``(X * Y * Z,)`` voxels that may be within ``far`` of samples ``(N, 3)``."""
    empty = np.ones(grid.shape, np.bool_)
    cell = np.rint((samples - grid.origin) / grid.spacing).astype(int)
    cell = cell[((cell >= 0) & (cell < grid.shape)).all(1)]
    empty[tuple(cell.T)] = False
    if empty.all():
        return np.ones(empty.size, np.bool_)
    return np.asarray(distance_transform_edt(empty) * grid.spacing <= far + 2 * grid.spacing).ravel()


def inside_mesh(grid: Grid, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    """``(X * Y * Z,)`` whether voxels are inside a closed mesh: the surface is crossed inwards on the way along z.

    A part that is turned inside out, as a deformed sphere may have them, has an inside, too.

    Args:
        grid: Where.
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
    """
    # Slightly off the centres: edges and corners of a mesh often lie on round numbers.
    shifted = (vertices - grid.origin) / grid.spacing + (1.234e-5, 2.345e-5, 0.0)
    a, b, c = shifted[faces].transpose(1, 0, 2)
    low = np.ceil(np.minimum(np.minimum(a, b), c)[:, :2]).clip(0)
    high = np.floor(np.maximum(np.maximum(a, b), c)[:, :2]).clip(None, np.array(grid.shape[:2]) - 1)
    width, height = (np.maximum(high - low + 1, 0).astype(int)).T
    face = np.repeat(np.arange(len(faces)), width * height)
    number = np.arange(len(face)) - np.repeat(np.cumsum(width * height) - width * height, width * height)
    x = low[face, 0] + number // np.maximum(height[face], 1)
    y = low[face, 1] + number % np.maximum(height[face], 1)
    at = np.stack([x, y], 1)

    def side(p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
        along, to = (q - p)[:, :2], at - p[:, :2]
        return np.asarray(along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0])

    weights = np.stack([side(b[face], c[face]), side(c[face], a[face]), side(a[face], b[face])])
    area = weights.sum(0)
    hit = ((weights > 0).all(0) | (weights < 0).all(0)) & (area != 0)
    z = (weights * np.stack([p[face, 2] for p in (a, b, c)])).sum(0)[hit] / area[hit]
    crossings = np.zeros((*grid.shape[:2], grid.shape[2] + 1))
    from_there = np.clip(np.ceil(z), 0, grid.shape[2]).astype(int)
    # A face that is counter-clockwise seen from above has its outside above: below it one is inside.
    np.add.at(crossings, (x[hit].astype(int), y[hit].astype(int), from_there), -np.sign(area[hit]))
    return np.asarray(np.abs(crossings.cumsum(2)[..., :-1]) > 0.5).ravel()
