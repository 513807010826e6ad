"""What no frame has shown of a shape is completed by its mirror image if the seen part is symmetric."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from tracking3d.reconstruction.meshing import FloatArray, Grid, decimate_roughly, extract_surface, main_pieces
from tracking3d.reconstruction.mirror_symmetry import SymmetryPlane, find_symmetry_planes
from tracking3d.reconstruction.plane_sweep import Guide
from tracking3d.reconstruction.seen_regions import seen_vertices
from tracking3d.scene.view import ObjectView

_FACES, _SAMPLES = 4000, 4000
_NEAR = 0.015  # uncertainty of the surface's depth, of the diagonal
_MAX_SEEN = 0.9  # share of the surface from which there is nothing to complete
_BAND = 2  # pixels around the silhouette that may belong to the object or to the background


def complete_by_symmetry(
    grid: Grid, inside: FloatArray, hull: FloatArray, views: Sequence[ObjectView]
) -> tuple[FloatArray, list[SymmetryPlane]]:
    """A shape, with its mirror images added where no view has looked.

    Args:
        grid: Where.
        inside: ``(N,)`` signed distance of the shape, positive inside.
        hull: ``(N,)`` signed distance from the visual hull, in the same unit: nothing is added outside.
        views: The frames.

    Returns:
        ``(N,)`` signed distance, and the planes of symmetry; none if what was seen supports none.
    """
    found = extract_surface(grid, inside)
    if found is None:
        return inside, []
    mesh = decimate_roughly(main_pieces(found), _FACES)
    points, normals, share = _sample_seen_surface(mesh, views)
    if share > _MAX_SEEN:
        return inside, []
    known = _Known.of(mesh, views)
    planes = find_symmetry_planes(points, normals, known.is_free)
    for plane in planes:
        inside = _add_image(grid, inside, hull, plane, known)
    return inside, planes


@dataclass(frozen=True, eq=False)
class _Known:
    """What the views have seen."""

    views: Sequence[ObjectView]  # the frames
    # (S, S) depth of the surface in each: infinite on the background, and minus infinite in a narrow band
    # around the silhouette, where pixels may belong to either
    depths: Sequence[NDArray[np.float32]]
    near: float  # uncertainty of these depths

    @classmethod
    def of(cls, mesh: trimesh.Trimesh, views: Sequence[ObjectView]) -> _Known:
        guide = Guide(np.asarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int64))
        diagonal = float(np.linalg.norm(np.ptp(guide.vertices, axis=0)))
        depths = [guide.visible_to(view)[0] for view in views]
        around = np.ones((2 * _BAND + 1,) * 2, np.uint8)
        for depth in depths:
            covered = np.isfinite(depth)
            depth[(cv2.dilate(covered.astype(np.uint8), around) > 0) & ~covered] = -np.inf
        return cls(views, depths, _NEAR * diagonal)

    def is_free(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """``(N,)`` whether a view sees through points ``(N, 3)`` to the surface or to the background."""
        return self._is_before(points, -self.near)

    def is_seen(self, points: NDArray[np.floating]) -> NDArray[np.bool_]:
        """``(N,)`` whether points ``(N, 3)`` are free, or within the uncertainty of a surface that a view sees."""
        return self._is_before(points, self.near)

    def _is_before(self, points: NDArray[np.floating], behind: float) -> NDArray[np.bool_]:
        before = np.zeros(len(points), bool)
        for view, depth in zip(self.views, self.depths, strict=True):
            P = view.P.astype(np.float32)
            x, y, z = P[:, :3] @ points.T.astype(np.float32) + P[:, 3:]
            z = np.maximum(z, 1e-6)
            column, row = np.rint(x / z).astype(int), np.rint(y / z).astype(int)
            looked = (column >= 0) & (row >= 0) & (column < len(depth)) & (row < len(depth))
            at = row.clip(0, len(depth) - 1), column.clip(0, len(depth) - 1)
            before |= looked & view.in_frame[at] & (z < depth[at] + behind)
        return before


def _sample_seen_surface(
    mesh: trimesh.Trimesh, views: Sequence[ObjectView]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Points ``(N, 3)`` spread over what was seen of a surface, their normals, and what share of it that is."""
    seen = seen_vertices(np.asarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int64), views)
    points, face = trimesh.sample.sample_surface(mesh, _SAMPLES, seed=0)
    shown = np.asarray(seen[mesh.faces].all(1))[face]
    return np.asarray(points)[shown], np.asarray(mesh.face_normals)[face][shown], float(shown.mean())


def _add_image(
    grid: Grid, inside: FloatArray, hull: FloatArray, plane: SymmetryPlane, known: _Known
) -> FloatArray:
    """The shape with its mirror image where that is within the hull and no view has looked."""
    asked = np.flatnonzero((hull > 0) & (inside < hull))
    points = grid.points[asked]
    images = (plane.reflect(points.astype(np.float64)) - grid.origin) / grid.spacing
    image = map_coordinates(
        inside.reshape(grid.shape), images.T, order=1, mode="constant", cval=float(inside.min())
    )
    larger = np.flatnonzero(image > inside[asked])
    added = larger[~known.is_seen(points[larger])]
    completed = inside.copy()
    completed[asked[added]] = np.minimum(image[added], hull[asked[added]])
    return completed
