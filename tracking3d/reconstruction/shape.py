"""The shape of an object of any topology, from all frames that are believed.

Silhouettes bound it, matched patches say how deep it is, and the mesh of the online map holds it where neither knows.
Each round fits the poses to the surface at hand, carves and matches anew, and fuses everything in a volume: depths
are as good as the poses are, and poses as the surface is. Every eighth frame is kept out; only if the new shape
explains those better than the old one does it take its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tracking3d.reconstruction.depth_maps import Guide, depth_maps
from tracking3d.reconstruction.fusion import depth_evidence, fused
from tracking3d.reconstruction.grid import FloatArray, Grid
from tracking3d.reconstruction.hull import robust_hull
from tracking3d.reconstruction.judged import EVERY, Explained, explained
from tracking3d.reconstruction.mesh_distance import mesh_distance
from tracking3d.reconstruction.outline_fit import fitted_to_outlines
from tracking3d.reconstruction.pose_polish import coloured_surface, mean_motion, polished
from tracking3d.reconstruction.shape_views import ShapeView, turned_apart
from tracking3d.reconstruction.surface import extracted, is_sound, main_pieces, roughly, simplified

FEWEST = 8
"""Frames that a shape is made from."""
LEAST_TURN = 20.0
"""Degrees by which the object has to turn; silhouettes and depths tell nothing below."""
MOST = 150
"""Frames that a shape is made from; of more, those that differ most."""
_APART, _REFERENCES_APART, _REFERENCES = 1.0, 6.0, 32  # degrees between views, and between those with a depth
_MARGIN = 0.15
_TRUNCATION = 0.05  # of the object's diagonal
_ROUNDS = ((64, 0.10, 10), (64, 0.06, 8), (96, 0.05, 8))
"""Cells along the longest side, how far around the last surface depths are searched (of the diagonal), in steps."""
_SMOOTH = (0.5, 0.8, 1.2)  # voxels; the first that gives a surface that is sound
_GUIDE_FACES, _FACES, _MOST_FACES = 4000, 6000, 12_000


@dataclass(frozen=True, eq=False)
class Shape:
    """What came of it.

    Attributes:
        vertices: ``(V, 3)``; faces: ``(F, 3)``: closed and oriented; None where the old shape stays.
        T_cam_obj: By frame, ``(4, 4)``: the poses that the shape was made with.
        sentence: What was found, or why the old shape stays.
        old: How the old shape explains the frames that were left out; None where it was not asked.
        new: How the new one does.
    """

    vertices: NDArray[np.float64] | None
    faces: NDArray[np.int64] | None
    T_cam_obj: dict[int, NDArray[np.float64]]
    sentence: str
    old: Explained | None = None
    new: Explained | None = None


def reconstructed(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], views: Sequence[ShapeView]
) -> Shape:
    """Make a shape that explains frames better than the one at hand.

    Args:
        vertices: ``(V, 3)`` of the shape at hand, closed.
        faces: ``(F, 3)``.
        views: All frames that are believed, in order.
    """
    left_out = [view for n, view in enumerate(views) if n % EVERY == EVERY // 2]
    used = turned_apart([view for n, view in enumerate(views) if n % EVERY != EVERY // 2], _APART, MOST)
    if len(used) < FEWEST or not left_out:
        return _kept(f"only {len(used)} frames differ enough to tell a shape, and {FEWEST} are needed")
    if (turn := _turn(used)) < LEAST_TURN:
        return _kept(f"the object turns by {turn:.0f} degrees only, and {LEAST_TURN:.0f} are needed")
    start = trimesh.Trimesh(vertices, faces, process=False)
    guide, given = start, used
    for cells, reach, steps in _ROUNDS:
        used = polished(coloured_surface(guide.vertices, guide.faces, used), used)
        grid, inside = _volume(start, guide, used, cells, reach, steps)
        found = extracted(grid, inside)
        if found is None:
            return _kept("the masks contradict each other: nothing is inside of all of them")
        guide = roughly(main_pieces(found), _GUIDE_FACES)
    mesh = _sound(grid, inside)
    if mesh is None:
        return _kept("what is seen contradicts itself: the new surface is full of holes")
    used = polished(coloured_surface(mesh.vertices, mesh.faces, used), used)
    fitted = fitted_to_outlines(
        np.asarray(mesh.vertices), np.asarray(mesh.faces), turned_apart(used, _REFERENCES_APART, _REFERENCES)
    )
    new_faces = np.asarray(mesh.faces, np.int64)
    old = explained(vertices, faces, polished(coloured_surface(vertices, faces, given), given), left_out)
    new = explained(fitted, new_faces, used, left_out)
    told = (
        f"silhouettes of {len(left_out)} frames that were left out agree by {new.iou:.3f} instead of {old.iou:.3f}, "
        f"colours differ by {new.colour:.3f} instead of {old.colour:.3f}"
    )
    if not new.better_than(old):
        return _kept(f"the new one is no better ({told})", old, new)
    # Back to where the object was: poses of the run and new shape belong together.
    T_after_before = mean_motion(given, used)
    poses = {view.index: view.T_cam_obj @ T_after_before for view in used}
    back = (fitted - T_after_before[:3, 3]) @ T_after_before[:3, :3]
    return Shape(back, new_faces, poses, told, old, new)


def _volume(
    start: trimesh.Trimesh,
    guide: trimesh.Trimesh,
    views: Sequence[ShapeView],
    cells: int,
    reach: float,
    steps: int,
) -> tuple[Grid, FloatArray]:
    """One round: all evidence in a volume, positive inside."""
    diagonal = float(np.linalg.norm(np.ptp(start.vertices, axis=0)))
    truncation = _TRUNCATION * diagonal
    grid = Grid.around(np.asarray(start.vertices), cells, _MARGIN)
    points = grid.points
    hull, _ = robust_hull(points, views, 2 * truncation)
    prior = mesh_distance(grid, np.asarray(start.vertices), np.asarray(start.faces), 1.2 * truncation)
    maps = depth_maps(
        views,
        turned_apart(views, _REFERENCES_APART, _REFERENCES),
        Guide(np.asarray(guide.vertices), np.asarray(guide.faces)),
        reach * diagonal,
        steps,
    )
    total, weight = depth_evidence(points, maps, truncation)
    return grid, fused(hull, prior, total, weight, truncation)


def _sound(grid: Grid, inside: FloatArray) -> trimesh.Trimesh | None:
    """The surface of a volume, as little smoothed as it needs to be closed and simple; None if that is not enough."""
    for smooth in _SMOOTH:
        found = extracted(grid, gaussian_filter(inside.reshape(grid.shape), smooth).ravel())
        if found is not None:
            mesh = simplified(main_pieces(found), _FACES)
            if is_sound(mesh) and len(mesh.faces) <= _MOST_FACES:
                return mesh
    return None


def _turn(views: Sequence[ShapeView]) -> float:
    """Degrees between the two views that differ most."""
    rotations = np.stack([view.T_cam_obj[:3, :3] for view in views])
    traces = np.einsum("nij,mij->nm", rotations, rotations)
    return float(np.degrees(np.arccos(np.clip((traces.min() - 1) / 2, -1, 1))))


def _kept(why: str, old: Explained | None = None, new: Explained | None = None) -> Shape:
    return Shape(None, None, {}, f"The mesh keeps its shape: {why}.", old, new)
