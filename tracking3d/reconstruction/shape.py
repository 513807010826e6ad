"""The shape of an object of any topology, from all reliable frames.

Silhouettes bound it, matched patches say how deep it is, and the mesh of the online map holds it where neither knows;
everything is fused in a volume. Poses are taken as they are: landmarks determine them to a tenth of a degree, which no
fit to a surface that is still rough can better. Every eighth frame is kept out; only if the new shape explains those
better than the old one does it take its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from tracking3d.points.outline_fit import fit_to_outlines
from tracking3d.reconstruction.grid import FloatArray, Grid
from tracking3d.reconstruction.held_out_test import HeldOutScore, score_held_out
from tracking3d.reconstruction.mesh_distance import mesh_distance
from tracking3d.reconstruction.meshing import (
    decimate_roughly,
    extract_surface,
    is_sound,
    main_pieces,
    simplify,
)
from tracking3d.reconstruction.mirror_completion import complete_by_symmetry
from tracking3d.reconstruction.mirror_symmetry import SymmetryPlane
from tracking3d.reconstruction.plane_sweep import Guide, depth_maps
from tracking3d.reconstruction.shape_views import ShapeView, spread_by_rotation
from tracking3d.reconstruction.silhouette_coverage import restore_uncovered
from tracking3d.reconstruction.tsdf_fusion import depth_evidence, fuse_depth
from tracking3d.reconstruction.visual_hull import carve_hull
from tracking3d.runtime.concurrency import start_in_thread
from tracking3d.runtime.progress import report_progress

FEWEST = 8
"""Frames that a shape is made from."""
LEAST_TURN = 20.0
"""Degrees by which the object has to turn; silhouettes and depths tell nothing below."""
MOST = 150
"""Frames that a shape is made from; of more, those that differ most."""
_APART, _REFERENCES_APART, _REFERENCES = 1.0, 6.0, 32  # degrees between views, and between those with a depth
_MARGIN = 0.15
_TRUNCATION = 0.04  # of the object's diagonal
_COARSE, _CELLS = (
    48,
    96,
)  # along the longest side, of the surface that says where to look, and of the one that is made
_REACH, _STEPS = 0.10, 10
"""How far around that surface depths are searched (of the diagonal), and in how many steps to either side."""
_SMOOTH = (0.5, 0.8, 1.2)  # voxels; the first that gives a surface that is sound
_GUIDE_FACES, _FACES, _MOST_FACES = 4000, 8000, 16_000


@dataclass(frozen=True, eq=False)
class ReconstructedShape:
    """What came of it."""

    # (V, 3); faces: (F, 3): closed and oriented; None if the old shape stays
    vertices: NDArray[np.float64] | None
    faces: NDArray[np.int64] | None
    sentence: str  # what was found, or why the old shape stays
    # how the old shape explains the frames that were left out; None if it was not asked
    old: HeldOutScore | None = None
    new: HeldOutScore | None = None  # how the new one does
    # the planes of symmetry by which unseen parts of the new shape were completed
    planes: Sequence[SymmetryPlane] = ()


def reconstruct_shape(
    starts: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]],
    views: Sequence[ShapeView],
    left_out: Sequence[ShapeView],
) -> ReconstructedShape:
    """Make a shape that explains frames better than the one at hand.

    Args:
        starts: Vertices ``(V, 3)`` and faces ``(F, 3)`` of the shape at hand, closed; and of others of the same object,
            which other videos have shown.
        views: The frames that it is made from, in order.
        left_out: The frames that it is judged by, see `is_held_out`.
    """
    used = spread_by_rotation(views, _APART, MOST)
    if len(used) < FEWEST or not left_out:
        return _keep_mesh(
            f"only {len(used)} frames differ enough to tell a shape, and {FEWEST} are needed; film it from more sides"
        )
    if (turn := largest_turn(np.stack([view.T_cam_obj[:3, :3] for view in used]))) < LEAST_TURN:
        return _keep_mesh(
            f"the object turns by {turn:.0f} degrees only, and {LEAST_TURN:.0f} are needed; film it turning further"
        )
    report_progress("carving the hull")
    vertices, faces = starts[0]
    scored = start_in_thread(partial(score_held_out, vertices, faces, used, left_out), cv2.getNumThreads())
    grid, inside, planes = _volume(starts, used)
    report_progress("extracting the surface")
    mesh = _check_shape(grid, inside)
    if mesh is None:
        return _keep_mesh(
            "masks and poses contradict each other, so that the new surface is full of holes; better masks help, "
            "for instance with --tracker segment"
        )
    new_faces = np.asarray(mesh.faces, np.int64)
    report_progress("fitting outlines")
    new_vertices = fit_to_outlines(
        np.asarray(mesh.vertices), new_faces, spread_by_rotation(used, _REFERENCES_APART, _REFERENCES)
    )
    old = scored()
    new = score_held_out(new_vertices, new_faces, used, left_out)
    comparison = (
        f"silhouettes of {len(left_out)} frames that were left out agree by {new.iou:.3f} instead of {old.iou:.3f}, "
        f"colours differ by {new.colour:.3f} instead of {old.colour:.3f}"
    )
    if not new.better_than(old):
        return _keep_mesh(f"the new one is no better ({comparison})", old, new)
    return ReconstructedShape(new_vertices, new_faces, comparison, old, new, planes)


def _volume(
    starts: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]], views: Sequence[ShapeView]
) -> tuple[Grid, FloatArray, list[SymmetryPlane]]:
    """All evidence in a volume, positive inside, and the planes by which it was completed."""
    vertices = np.concatenate([points for points, _ in starts])
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    truncation = _TRUNCATION * diagonal
    bounds = {}
    references = spread_by_rotation(views, _REFERENCES_APART, _REFERENCES)
    for cells in (_COARSE, _CELLS):
        grid = Grid.around(vertices, cells, _MARGIN)
        measured = start_in_thread(
            partial(_start_distance, grid, starts, 1.2 * truncation), cv2.getNumThreads()
        )
        hull, _ = carve_hull(grid.points, views, 2 * truncation)
        prior = measured()
        bounds[cells] = grid, hull, restore_uncovered(grid, hull, prior, references)
    maps = depth_maps(
        views,
        references,
        _guide(*bounds[_COARSE], *starts[0]),
        _REACH * diagonal,
        _STEPS,
    )
    grid, hull, prior = bounds[_CELLS]
    total, weight = depth_evidence(grid.points, maps, truncation)
    fused = fuse_depth(grid.shape, hull, prior, total, weight, truncation)
    return grid, *complete_by_symmetry(grid, fused, hull / truncation, references)


def _start_distance(
    grid: Grid, starts: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]], far: float
) -> FloatArray:
    """``(N,)`` signed distance from the shapes at hand; what one video has not shown is often missing from its own."""
    return np.maximum.reduce([mesh_distance(grid, points, faces, far) for points, faces in starts])


def _guide(
    grid: Grid,
    hull: FloatArray,
    prior: FloatArray,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
) -> Guide:
    """The mesh of the online map as far as it is within the hull: where depths are looked for."""
    found = extract_surface(grid, np.minimum(hull, prior))
    if found is None:
        return Guide(vertices, faces)
    mesh = decimate_roughly(main_pieces(found), _GUIDE_FACES)
    return Guide(np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64))


def _check_shape(grid: Grid, inside: FloatArray) -> trimesh.Trimesh | None:
    """The surface of a volume, as little smoothed as it needs to be closed and simple; None if that is not enough."""
    for smooth in _SMOOTH:
        found = extract_surface(grid, gaussian_filter(inside.reshape(grid.shape), smooth).ravel())
        if found is not None:
            mesh = simplify(main_pieces(found), _FACES)
            if is_sound(mesh) and len(mesh.faces) <= _MOST_FACES:
                return mesh
    return None


def largest_turn(rotations: NDArray[np.float64]) -> float:
    """Degrees between the two of several rotations ``(N, 3, 3)`` that differ most."""
    traces = np.einsum("nij,mij->nm", rotations, rotations)
    return float(np.degrees(np.arccos(np.clip((traces.min() - 1) / 2, -1, 1))))


def _keep_mesh(
    why: str, old: HeldOutScore | None = None, new: HeldOutScore | None = None
) -> ReconstructedShape:
    return ReconstructedShape(None, None, f"The mesh keeps its shape: {why}.", old, new)
