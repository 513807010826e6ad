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
from tracking3d.reconstruction.held_out_test import HeldOutScore, score_held_out
from tracking3d.reconstruction.meshing import (
    FloatArray,
    Grid,
    decimate_roughly,
    extract_surface,
    is_sound,
    main_pieces,
    simplify,
)
from tracking3d.reconstruction.mirror_completion import complete_by_symmetry
from tracking3d.reconstruction.mirror_symmetry import SymmetryPlane
from tracking3d.reconstruction.plane_sweep import DepthMap, Guide, depth_maps
from tracking3d.reconstruction.views import spread_by_rotation
from tracking3d.runtime.concurrency import start_in_thread
from tracking3d.runtime.progress import report_each, report_progress
from tracking3d.scene.view import ObjectView

FEWEST = 8
"""Frames that a shape is made from."""
LEAST_TURN = 20.0
"""Degrees by which the object has to turn; silhouettes and depths tell nothing below."""
MOST = 60
"""Frames that a shape is made from; of more, those that differ most (measured: 40 lose .06 dB on box_in_hand)."""
_APART, _REFERENCES_APART, _REFERENCES = 1.0, 6.0, 20  # degrees between views, and between those with a depth
_WIDE = 10.0  # degrees from a view to the nearest one, at the median, from which they are photos in wide steps (chosen)
_MARGIN = 0.15
_TRUNCATION = 0.04  # of the object's diagonal
_COARSE, _CELLS = (
    48,
    96,
)  # along the longest side, of the surface that says where to look, and of the one made
_BAND = 2.0  # coarse voxels around the coarse hull in which it is carved finely; elsewhere it is interpolated
_REACH, _STEPS = 0.10, 10
"""How far around that surface depths are searched (of the diagonal), and in how many steps to either side."""
_SMOOTH = (0.5, 0.8, 1.2)  # voxels; the first that gives a surface that is sound
_GUIDE_FACES, _FACES, _MOST_FACES = 4000, 6000, 16_000


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
    views: Sequence[ObjectView],
    left_out: Sequence[ObjectView],
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
    wide = are_wide_apart(used)
    references = used if wide else spread_by_rotation(used, _REFERENCES_APART, _REFERENCES)
    score = partial(score_held_out, views=references, left_out=left_out)
    scored = start_in_thread(partial(score, *starts[0]), cv2.getNumThreads())
    grid, inside, planes = _volume(starts, used, references, wide)
    report_progress("extracting the surface")
    mesh = _check_shape(grid, inside)
    if mesh is None:
        return _keep_mesh(
            "masks and poses contradict each other, so that the new surface is full of holes; better masks help, "
            "for instance with --tracker segment"
        )
    new_faces = np.asarray(mesh.faces, np.int64)
    report_progress("fitting outlines")
    new_vertices = fit_to_outlines(np.asarray(mesh.vertices), new_faces, references)
    old, new = scored(), score(new_vertices, new_faces)
    comparison = (
        f"silhouettes of {len(left_out)} frames that were left out agree by {new.iou:.3f} instead of {old.iou:.3f}, "
        f"colours differ by {new.colour:.3f} instead of {old.colour:.3f}"
    )
    if not new.better_than(old):
        return _keep_mesh(f"the new one is no better ({comparison})", old, new)
    return ReconstructedShape(new_vertices, new_faces, comparison, old, new, planes)


def _volume(
    starts: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]],
    views: Sequence[ObjectView],
    references: Sequence[ObjectView],
    wide: bool,
) -> tuple[Grid, FloatArray, list[SymmetryPlane]]:
    """All evidence in a volume, positive inside, and the planes by which it was completed."""
    vertices = np.concatenate([points for points, _ in starts])
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    truncation = _TRUNCATION * diagonal
    coarse = Grid.around(vertices, _COARSE, _MARGIN)
    around, _ = carve_hull(coarse.points, views, 2 * truncation)
    prior = _prior(coarse, around, starts, references, truncation)
    guide = _guide(coarse, around, prior, *starts[0])
    maps = depth_maps(views, references, guide, _REACH * diagonal, _STEPS, wide=wide)
    grid = coarse.around_centres(around > -coarse.spacing, coarse.spacing * _COARSE / _CELLS)
    hull = coarse.resample(around, grid)
    near = np.abs(hull) < _BAND * coarse.spacing
    hull[near], _ = carve_hull(grid.points[near], views, 2 * truncation)
    prior = _prior(grid, hull, starts, references, truncation)
    total, weight = np.zeros_like(hull), np.zeros_like(hull)
    inside = hull > -truncation
    total[inside], weight[inside] = depth_evidence(grid.points[inside], maps, truncation)
    fused = fuse_depth(grid.shape, hull, prior, total, weight, truncation)
    return grid, *complete_by_symmetry(grid, fused, hull / truncation, references)


def _prior(
    grid: Grid,
    hull: FloatArray,
    starts: Sequence[tuple[NDArray[np.float64], NDArray[np.int64]]],
    references: Sequence[ObjectView],
    truncation: float,
) -> FloatArray:
    """``(N,)`` signed distance from the shapes at hand, with that from the hull where views show that they lack it."""
    distances = [mesh_distance(grid, points, faces, 1.2 * truncation) for points, faces in starts]
    return restore_uncovered(grid, hull, np.maximum.reduce(distances), references)


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


def are_wide_apart(views: Sequence[ObjectView]) -> bool:
    """Whether the views are photos in wide steps, each far from the nearest other one."""
    R = np.stack([view.T_cam_obj[:3, :3] for view in views])
    traces = np.einsum("nij,mij->nm", R, R) - 4 * np.eye(len(R))
    return bool(np.median(traces.max(1)) < 1 + 2 * np.cos(np.radians(_WIDE)))


def _keep_mesh(
    why: str, old: HeldOutScore | None = None, new: HeldOutScore | None = None
) -> ReconstructedShape:
    return ReconstructedShape(None, None, f"The mesh keeps its shape: {why}.", old, new)


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
    from tracking3d.reconstruction.kernels.visual_hull import surface_distance

    distance = np.empty(grid.shape, np.float32)
    corners = np.ascontiguousarray((vertices[faces] - grid.origin) / grid.spacing)
    surface_distance(corners, far / grid.spacing, distance)
    # A centre on a face that is inside stays inside.
    distance = np.maximum(distance.ravel(), 1e-6) * np.float32(grid.spacing)
    return np.where(inside_mesh(grid, vertices, faces), distance, -distance)


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


# Where a shape has to be larger, since views show the object where it is not.
#
# A shape that is too small leaves pixels of the masks uncovered. A voxel that is within the visual hull, and that
# several views see at such pixels, is likely to be part of the object.

LEAST_VIEWS = 3
"""Views that have to see a voxel at a pixel of the object that the shape does not cover."""
_TOLERANCE = 2  # pixels around the shape's silhouette that count as covered
_COVERAGE_FACES = 6000


def restore_uncovered(
    grid: Grid, hull: FloatArray, shape: FloatArray, views: Sequence[ObjectView]
) -> FloatArray:
    """A shape's signed distance, with that of the hull where views show the object and the shape is too small.

    Args:
        grid: Where.
        hull: ``(N,)`` signed distance from the visual hull, positive inside.
        shape: ``(N,)`` from the shape, positive inside.
        views: The frames.

    Returns:
        ``(N,)``.
    """
    found = extract_surface(grid, np.minimum(hull, shape))
    if found is None:
        return hull
    mesh = decimate_roughly(found, _COVERAGE_FACES)
    guide = Guide(np.asarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int64))
    asked = np.flatnonzero((hull > 0) & (shape <= 0))
    points = grid.points[asked]
    votes = np.zeros(len(asked), int)
    for view in views:
        uncovered = _uncovered_pixels(guide, view)
        if uncovered.any():
            x, y, z = view.P[:, :3].astype(np.float32) @ points.T + view.P[:, 3:].astype(np.float32)
            z = np.maximum(z, 1e-6)
            pixel = np.rint(np.stack([y, x]) / z)
            inside = ((pixel >= 0) & (pixel < len(uncovered))).all(0)
            row, column = pixel[:, inside].astype(int)
            votes[inside] += uncovered[row, column]
    restored = shape.copy()
    missing = asked[votes >= LEAST_VIEWS]
    restored[missing] = hull[missing]
    return restored


def _uncovered_pixels(guide: Guide, view: ObjectView) -> NDArray[np.bool_]:
    """``(S, S)`` the pixels of a view's mask that a surface leaves uncovered, more than a few pixels off."""
    depth, _ = guide.visible_to(view)
    around = np.ones((2 * _TOLERANCE + 1,) * 2, np.uint8)
    return view.mask & (cv2.dilate(np.isfinite(depth).astype(np.uint8), around) == 0)


# All evidence of a shape in one truncated signed distance volume.
#
# Positive inside. What matched depths say of a voxel is a weighted mean (Curless and Levoy, "A volumetric method for
# building complex models from range images", 1996): near a depth its distance from it, before it that the voxel is
# free. Behind it nothing is known. The mesh of the online map is one more such measurement, a weak one, decisive where
# nothing else knows. Nothing reaches beyond the visual hull. Among volumes that agree about as well with that, the one
# with the least total variation is taken (Zach, Pock and Bischof, "A globally optimal algorithm for robust TV-L1 range
# image integration", 2007): noise and holes go, and what nobody saw is closed by a small surface.

FREE = 0.25
"""Weight of a depth in the free space before it: a wrong depth would otherwise carve a tunnel."""
PRIOR = 0.3
"""Weight of the mesh, in depths."""
VARIATION = 0.5
"""Weight of the total variation of distances in truncations, voxel to voxel."""
_STEEP = 0.1  # difference from voxel to voxel below which it counts with its square
_ROUNDS = 80


def depth_evidence(
    points: FloatArray, maps: Sequence[DepthMap], truncation: float
) -> tuple[FloatArray, FloatArray]:
    """What depth maps say.

    Args:
        points: ``(N, 3)`` in object coordinates.
        maps: The depths.
        truncation: Distances are cut off there.

    Returns:
        ``(N,)`` weighted sum of signed distances, and ``(N,)`` of weights.
    """
    total, weight = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for one in report_each("fusing depths", maps):
        P = one.view.P.astype(np.float32)
        x, y, z = P[:, :3] @ points.T + P[:, 3:]
        ahead = z > 1e-6
        depth, score = _sample_depth(one, x, y, z, ahead)
        behind = depth - z  # of the voxel to the surface: positive where it is free
        known = np.isfinite(behind) & (behind > -truncation)
        near = known & (behind < truncation)
        say = np.where(near, 1.0, FREE) * score
        total[known] -= (say * np.clip(behind, -truncation, truncation))[known]
        weight[known] += say[known]
    return total, weight


def fuse_depth(
    shape: tuple[int, int, int],
    hull: FloatArray,
    prior: FloatArray,
    total: FloatArray,
    weight: FloatArray,
    truncation: float,
    variation: float = VARIATION,
) -> FloatArray:
    """``(N,)`` signed distance of the surface in truncations, positive inside.

    Args:
        shape: Shape of the grid of N voxels.
        hull: ``(N,)`` signed distance from the visual hull.
        prior: ``(N,)`` from the mesh of the online map.
        total: ``(N,)`` and weight: ``(N,)`` from `depth_evidence`.
        truncation: Distances are cut off there.
        variation: Weight of the total variation; 0 takes the mean as it is.
    """
    from tracking3d.reconstruction.kernels.visual_hull import vary_little

    sum_of_weights = weight + np.float32(PRIOR)
    mean = (total / truncation + PRIOR * np.clip(prior / truncation, -1, 1)) / sum_of_weights
    parts = mean, sum_of_weights, np.clip(hull / truncation, -1, 1)
    given = [np.ascontiguousarray(part, np.float32).reshape(shape) for part in parts]
    distance = np.minimum(given[0], given[2])
    if variation:
        vary_little(*given, _STEEP, variation, _ROUNDS, distance)
    return distance.ravel()


def _sample_depth(
    one: DepthMap, x: FloatArray, y: FloatArray, z: FloatArray, ahead: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """The depth and score nearest to where each point is seen; a map knows every ``stride``-th pixel."""
    stride = one.stride
    depths, scores = one.depth[::stride, ::stride], one.score[::stride, ::stride]
    last = len(depths) - 0.5
    depth, score = np.full(len(x), np.nan, np.float32), np.zeros(len(x), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = x / z / stride, y / z / stride
        seen = ahead & (column > -0.5) & (column < last) & (row > -0.5) & (row < last)
    at = np.rint(row[seen]).astype(int), np.rint(column[seen]).astype(int)
    depth[seen], score[seen] = depths[at], scores[at]
    return depth, score


# The visual hull, robust against a share of wrong masks.
#
# A point is outside where enough views put it there. In each view its distance from the mask's outline is taken into
# space by the point's depth; of these signed distances, negative outside, the hull has not the least one but the one at
# a low rank: a few wrong masks, or a hand that passes, carve nothing. What is left is about the signed distance from
# the hull, and smooth, so that a surface lies between the voxels.

SHARE = 0.05
"""Share of the views that see a point and may be wrong."""
LEAST = 1
"""And so many at least."""


def carve_hull(
    points: FloatArray,
    views: Sequence[ObjectView],
    far: float,
    share: float = SHARE,
    least: int = LEAST,
) -> tuple[FloatArray, FloatArray]:
    """Signed distance from the hull, positive inside, and by how many views it is known.

    Args:
        points: ``(N, 3)`` in object coordinates.
        views: The frames.
        far: Distances are cut off there.
        share: Share of the views that may be wrong.
        least: Number of views that may be wrong however few there are.

    Returns:
        ``(N,)`` and ``(N,)``. A point that no view sees is inside.
    """
    P = np.stack([view.P for view in views])
    focal = np.array([view.K[0, 0] for view in views])
    inside = np.stack([view.signed_distance for view in views])
    within = np.stack([view.frame_edges for view in views])
    from tracking3d.reconstruction.kernels.visual_hull import robust_hull as compiled

    hull, seen = np.empty(len(points), np.float32), np.empty(len(points), np.float32)
    compiled(
        np.ascontiguousarray(points, np.float32), P, focal, inside, within, share, least, far, hull, seen
    )
    return hull, seen
