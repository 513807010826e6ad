"""Distance of an estimated surface from the true one, over all of it and over its visible part.

Distances run from points spread evenly over one mesh to the surface of the other. Figures are in object diameters. The
alignment is given (`tracking3d_bench.evaluation.alignment`); none is searched here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tracking3d_bench.evaluation.arrays import finite

TOLERANCE = 0.02
"""Distance in diameters below which a point of one surface is on the other."""

FINE_TOLERANCE = 0.01
"""The same, for what is to be right in detail."""

SAMPLES = 100_000
"""Points on each surface."""

_NEAREST = 5


@dataclass(frozen=True)
class ShapeScores:
    """Scores of one estimated mesh.

    Attributes:
        chamfer: Mean distance from the estimated to the true surface and back, half of their sum, in diameters.
        accuracy: Mean distance from the estimated to the true surface, in diameters.
        completeness: Mean distance from the true to the estimated surface, in diameters.
        precision: Share of the estimated surface that is on the true one.
        recall: Share of the true surface that is on the estimated one.
        f_score: Harmonic mean of the two.
        f_score_fine: The same at `FINE_TOLERANCE`.
        f_score_seen: `f_score` of what was seen: of the true surface, and of what lies nearest to that; None if
            it is unknown what was seen.
        f_score_fine_seen: The same at `FINE_TOLERANCE`.
        normals: Mean cosine between the normals of points of either surface and those of the nearest of the other.
        genus_error: By how many handles the estimate differs; None unless both are one closed surface.
    """

    chamfer: float
    accuracy: float
    completeness: float
    precision: float
    recall: float
    f_score: float
    f_score_fine: float
    f_score_seen: float | None
    f_score_fine_seen: float | None
    normals: float
    genus_error: int | None


def shape_scores(
    estimated: trimesh.Trimesh,
    true: trimesh.Trimesh,
    diameter: float,
    T_true_est: NDArray[np.float64] | None = None,
    samples: int = SAMPLES,
    seed: int = 0,
    seen: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]] | None = None,
) -> ShapeScores:
    """Chamfer distance and F-score (Knapitsch et al., "Tanks and temples", 2017) of two meshes.

    Args:
        estimated: In estimated object coordinates.
        true: In true object coordinates.
        diameter: Diameter of the true mesh, in its unit.
        T_true_est: ``(4, 4)`` similarity from estimated to true coordinates; None if they are the same.
        samples: Points on each surface.
        seed: Seed of the points.
        seen: Says of points ``(N, 3)`` of the true surface with normals ``(N, 3)`` which were seen.

    Raises:
        ValueError: If a mesh has no area, or the diameter is not positive, or the similarity is not finite.
    """
    if not 0 < diameter < np.inf:
        raise ValueError(f"the diameter needs to be positive, got {diameter}")
    for name, mesh in (("estimated", estimated), ("true", true)):
        if not (np.isfinite(mesh.area) and mesh.area > 0):
            raise ValueError(f"the {name} mesh has the area {mesh.area}, so no surface to compare")
    T = np.eye(4) if T_true_est is None else finite("T_true_est", T_true_est, 4, 4)
    aligned = estimated.copy().apply_transform(T)
    points, faces = _sample(aligned, samples, seed)
    true_points, true_faces = _sample(true, samples, seed + 1)
    to_true = _distances(points, true_points, true.triangles[true_faces]) / diameter
    to_estimated = _distances(true_points, points, aligned.triangles[faces]) / diameter
    nearest_true, nearest = cKDTree(true_points).query(points)[1], cKDTree(points).query(true_points)[1]
    normals, true_normals = aligned.face_normals[faces], true.face_normals[true_faces]
    agree = [
        (normals * true_normals[nearest_true]).sum(1).mean(),
        (true_normals * normals[nearest]).sum(1).mean(),
    ]
    on_seen = None
    if seen is not None and (shown := seen(true_points, true_normals)).any() and shown[nearest_true].any():
        on_seen = to_true[shown[nearest_true]], to_estimated[shown]
    return ShapeScores(
        chamfer=float(to_true.mean() + to_estimated.mean()) / 2,
        accuracy=float(to_true.mean()),
        completeness=float(to_estimated.mean()),
        precision=float(np.mean(to_true < TOLERANCE)),
        recall=float(np.mean(to_estimated < TOLERANCE)),
        f_score=_f_score(to_true, to_estimated, TOLERANCE),
        f_score_fine=_f_score(to_true, to_estimated, FINE_TOLERANCE),
        f_score_seen=None if on_seen is None else _f_score(*on_seen, TOLERANCE),
        f_score_fine_seen=None if on_seen is None else _f_score(*on_seen, FINE_TOLERANCE),
        normals=float(np.mean(agree)),
        genus_error=_genus_error(aligned, true),
    )


def _f_score(to_true: NDArray[np.float64], to_estimated: NDArray[np.float64], tolerance: float) -> float:
    precision, recall = (float(np.mean(one < tolerance)) for one in (to_true, to_estimated))
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def _genus_error(estimated: trimesh.Trimesh, true: trimesh.Trimesh) -> int | None:
    genera = []
    for mesh in (estimated, true):
        whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        whole.merge_vertices()
        if not whole.is_watertight or whole.body_count != 1:
            return None
        genera.append((2 - whole.euler_number) // 2)
    return int(abs(genera[0] - genera[1]))


def _sample(mesh: trimesh.Trimesh, count: int, seed: int) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """``(N, 3)`` points, as many on every piece of equal area, and their faces ``(N,)``."""
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points), faces


def _distances(
    points: NDArray[np.float64], samples: NDArray[np.float64], triangles: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Distance ``(N,)`` of each point to the nearest of the triangles that hold the samples nearest to it.

    To the samples alone it would be too large by the gaps between them: 0.3 % of the diameter for the default number
    on a sphere, against 0.04 % or less.

    Args:
        points: ``(N, 3)``.
        samples: ``(M, 3)`` points of the surface.
        triangles: ``(M, 3, 3)`` corners of the face that each sample lies on.
    """
    nearest = min(_NEAREST, len(samples))
    _, found = cKDTree(samples).query(points, k=nearest)
    candidates = triangles[found.reshape(-1)]
    closest = trimesh.triangles.closest_point(candidates, np.repeat(points, nearest, axis=0))
    return np.linalg.norm(closest.reshape(-1, nearest, 3) - points[:, None], axis=2).min(1)
