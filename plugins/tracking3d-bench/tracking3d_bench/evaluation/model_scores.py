"""Scores of poses and shape against the true mesh: BOP's average recall, Chamfer distance and F-score."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh

from tracking3d.geometry.alignment import ObjectAlignment
from tracking3d_bench.datasets.answers import Answers
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation.alignment import align_on_frame
from tracking3d_bench.evaluation.bop import AverageRecall, average_recall, mspd, mssd
from tracking3d_bench.evaluation.pose_scores import PosePairs
from tracking3d_bench.evaluation.seen_surface import make_visibility_test
from tracking3d_bench.evaluation.shape import ShapeScores, shape_scores
from tracking3d_bench.evaluation.surface_alignment import align_surfaces
from tracking3d_bench.evaluation.vsd import TOLERANCES, VISIBILITY_TOLERANCE, model_depth, vsd

SAMPLES = 30_000
"""Points on each surface: a third of the time of a precise figure, and the same three digits."""


@dataclass(frozen=True, kw_only=True)
class ModelScores:
    """Poses and shape if the true mesh is known; None otherwise.

    Attributes:
        bop_ar: Mean of the next three; None unless all are known.
        bop_ar_vsd: Average recall of the visible surface discrepancy; needs depth and the unit in millimetres.
        bop_ar_mssd: Average recall of the maximum surface distance.
        bop_ar_mspd: Average recall of the maximum projection distance; needs the camera.
        chamfer_percent: Symmetric Chamfer distance in percent of the object's diameter.
        shape_f_score: F-score at 2 percent of the diameter.
        shape_f_score_fine: At 1 percent.
        shape_f_score_seen: At 2 percent, of the surface that the frames show; needs the camera.
        shape_f_score_fine_seen: The same at 1 percent.
        shape_f_score_fitted: At 2 percent, of the surface that the frames show (all of it, if the camera is not
            known), size and place fitted to the surfaces instead of the poses.
        shape_f_score_fine_fitted: The same at 1 percent.
        shape_accuracy_percent: Mean distance of the estimated from the true surface in percent of the diameter.
        shape_completeness_percent: Completeness of the true from the estimated surface.
        shape_normals: Mean cosine between normals of the two surfaces.
        shape_genus_error: By how many handles they differ; None unless both are one closed surface.
    """

    bop_ar: float | None = None
    bop_ar_vsd: float | None = None
    bop_ar_mssd: float | None = None
    bop_ar_mspd: float | None = None
    chamfer_percent: float | None = None
    shape_f_score: float | None = None
    shape_f_score_fine: float | None = None
    shape_f_score_seen: float | None = None
    shape_f_score_fine_seen: float | None = None
    shape_f_score_fitted: float | None = None
    shape_f_score_fine_fitted: float | None = None
    shape_accuracy_percent: float | None = None
    shape_completeness_percent: float | None = None
    shape_normals: float | None = None
    shape_genus_error: float | None = None


def score_model(
    answers: Answers,
    truth: Truth,
    pairs: PosePairs | None,
    alignment: ObjectAlignment | None,
    mesh: trimesh.Trimesh | None,
    diameter: float | None,
) -> ModelScores:
    """Score poses and shape against the true mesh.

    Poses are carried into the true object frame by the similarity under which the first frame with an estimate
    agrees, with the scale of all frames; the shape by ``alignment``, that of all frames. A frame without an estimate
    is wrong at every threshold.

    Args:
        answers: The method's results.
        truth: The clip's.
        pairs: Their poses.
        alignment: Fitted to all frames.
        mesh: The true shape.
        diameter: Its diameter.
    """
    pairs = pairs and pairs.with_rotation.with_position
    if pairs is None or not pairs.frames or mesh is None or diameter is None:
        return ModelScores()
    recall = _recall(truth, pairs, alignment, mesh, diameter)
    shape = fitted = None
    if alignment is not None and answers.mesh is not None:
        try:
            seen = None
            if truth.camera is not None:
                seen = make_visibility_test(mesh, diameter, list(truth.T_cam_obj.values()), truth.camera)
            estimated = answers.mesh()
            shape = shape_scores(estimated, mesh, diameter, alignment.T_true_est, SAMPLES, seen=seen)
            fits = align_surfaces(estimated, mesh, diameter, alignment.T_true_est, seen)
            scores = [shape_scores(estimated, mesh, diameter, fit, SAMPLES, seen=seen) for fit in fits]
            fitted = max([shape, *scores], key=lambda one: _seen_or_all(one)[0])
        except ValueError:  # the method has no surface: there is nothing to measure
            shape = fitted = None
    return ModelScores(
        bop_ar=recall.mean,
        bop_ar_vsd=recall.vsd,
        bop_ar_mssd=recall.mssd,
        bop_ar_mspd=recall.mspd,
        chamfer_percent=100 * shape.chamfer if shape else None,
        **(_of_shape(shape) if shape else {}),
        shape_f_score_fitted=_seen_or_all(fitted)[0] if fitted else None,
        shape_f_score_fine_fitted=_seen_or_all(fitted)[1] if fitted else None,
    )


def _seen_or_all(shape: ShapeScores) -> tuple[float, float]:
    """F-scores at 2 and at 1 percent of what was seen, or of all of the surface if that is not known."""
    if shape.f_score_seen is None or shape.f_score_fine_seen is None:
        return shape.f_score, shape.f_score_fine
    return shape.f_score_seen, shape.f_score_fine_seen


def _of_shape(shape: ShapeScores) -> dict[str, float | None]:
    return {
        "shape_f_score": shape.f_score,
        "shape_f_score_fine": shape.f_score_fine,
        "shape_f_score_seen": shape.f_score_seen,
        "shape_f_score_fine_seen": shape.f_score_fine_seen,
        "shape_accuracy_percent": 100 * shape.accuracy,
        "shape_completeness_percent": 100 * shape.completeness,
        "shape_normals": shape.normals,
        "shape_genus_error": shape.genus_error,
    }


def _recall(
    truth: Truth,
    pairs: PosePairs,
    alignment: ObjectAlignment | None,
    mesh: trimesh.Trimesh,
    diameter: float,
) -> AverageRecall:
    count, camera = len(pairs.frames), truth.camera
    distances, pixels = np.full((2, count), np.inf)
    surface = np.full((count, len(TOLERANCES)), np.inf)
    measured = [place for place, n in enumerate(pairs.frames) if n in truth.depth]
    points = np.asarray(mesh.vertices, dtype=np.float64)
    outer = np.asarray(mesh.convex_hull.vertices, dtype=np.float64)
    if alignment is not None:
        on_first = align_on_frame(pairs.T_est[0], pairs.T_true[0], alignment.scale)
        for place, T_est, T_true in zip(pairs.found, on_first.poses(pairs.T_est), pairs.T_true, strict=True):
            # The farthest point of a rigid difference lies on the hull; projections are no such thing.
            distances[place] = mssd(T_est, T_true, outer, truth.symmetries)
            if camera is None:
                continue
            pixels[place] = mspd(T_est, T_true, camera.K, points, truth.symmetries)
            depth = truth.depth.get(pairs.frames[place])
            if depth is not None and truth.millimetres is not None:
                size = camera.width, camera.height
                of_est, of_true = (
                    model_depth(points, mesh.faces, T, camera.K, size) for T in (T_est, T_true)
                )
                delta = VISIBILITY_TOLERANCE / truth.millimetres
                surface[place] = vsd(of_est, of_true, depth.read(), camera.K, delta, diameter)
    with_depth = camera is not None and truth.millimetres is not None and bool(measured)
    return average_recall(
        surface[measured] if with_depth else None,
        distances,
        None if camera is None else pixels,
        diameter,
        camera.width if camera else 1,
    )
