"""Kernel of the module of the same name in `optimization`: a frame's poses are fitted in one call."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, void
from numpy.typing import NDArray

from tracking3d.estimation.online.optimization.types import NOTHING_SEEN, PoseWeights
from tracking3d.geometry.levenberg_marquardt import Damping
from tracking3d.points.bundle_adjustment.kernels.reprojection import pose_minimizer, shared
from tracking3d.points.bundle_adjustment.reprojection import EvaluatedPose, FloatArray
from tracking3d.rendering import MatchedPoints, PoseTarget, Surface
from tracking3d.rendering.kernels.compilation import kernel, record, share
from tracking3d.rendering.kernels.normal_equations import COMPARABLE, KNOWN, SURFACE
from tracking3d.rendering.kernels.pose_terms import (
    APPEARANCE,
    BOTH,
    EITHER,
    MATCHES,
    OUTLINE,
    POINTS,
    SCALES,
    TARGET,
    LossScales,
    drawing_buffers,
    packed,
    terms_of_pose,
)
from tracking3d.rendering.pose_comparison import NEAREST_POINT, check_comparison

_APPEARANCE, _OUTLINE, _POINTS, _OVERLAP, _UNSEEN = range(5)
_DAMPING = Damping()


class _PoseArrays(NamedTuple):
    """B poses, see `EvaluatedPose`; written to."""

    cost: FloatArray
    R: FloatArray
    t: FloatArray
    details: FloatArray
    matrix: FloatArray
    gradient: FloatArray
    tried: NDArray[np.int64]  # (B,) steps


_POSES = record(
    _PoseArrays,
    float64[::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1],
    int64[::1],
)  # fmt: skip


class _Frame(NamedTuple):
    """What a pose is evaluated with."""

    surface: Any
    target: Any
    matches: Any
    scales: LossScales
    weights: FloatArray
    buffers: Any


def minimize(
    surface: Surface,
    target: PoseTarget,
    matched: MatchedPoints | None,
    weights: PoseWeights,
    R: FloatArray,
    t: FloatArray,
    steps: int,
) -> list[tuple[EvaluatedPose, int]]:
    """See `tracking3d.estimation.online.optimization.pose_refinement`."""
    check_comparison(surface, target, matched)
    count = len(R)
    poses = _PoseArrays(
        np.empty(count), np.array(R, np.float64, order="C"), np.array(t, np.float64, order="C"),
        np.empty((count, 5)), np.empty((count, 6, 6)), np.empty((count, 6)), np.empty(count, np.int64),
    )  # fmt: skip
    scales = LossScales(
        *map(float, (weights.appearance_scale, weights.outline_scale, weights.points_scale, NEAREST_POINT))
    )
    share(
        _minimize, count, 2, *packed(surface, target, matched), scales,
        np.array([weights.appearance, weights.outline, weights.points, weights.unseen]), steps, poses,
    )  # fmt: skip
    parts = poses.cost.tolist(), *poses[1:-1], poses.tried.tolist()
    return [(EvaluatedPose(*each), tried) for *each, tried in zip(*parts, strict=True)]


@shared
def _evaluate(frame, R, t):
    """The pose with its cost; see `tracking3d.estimation.online.optimization.pose_refinement`."""
    surface, target, matches, scales, weights, buffers = frame
    sums, counts = np.zeros((3, 7, 7)), np.zeros(4)
    terms_of_pose(
        surface, target, matches, R.astype(np.float32), t.astype(np.float32), scales, buffers, sums, counts
    )
    details = np.empty(5)
    nothing = counts[COMPARABLE] == 0
    unseen = 1.0 if nothing else 1 - counts[KNOWN] / counts[COMPARABLE]
    details[_UNSEEN] = unseen
    details[_APPEARANCE] = (
        sums[APPEARANCE, 6, 6] * (1 - unseen) + weights[3] * unseen + NOTHING_SEEN * nothing
    )
    details[_OUTLINE], details[_POINTS] = sums[OUTLINE, 6, 6], sums[POINTS, 6, 6]
    details[_OVERLAP] = counts[BOTH] / max(counts[EITHER], 1.0) if target.mask.size > 0 else 1.0
    cost = weights[0] * details[_APPEARANCE] + weights[1] * details[_OUTLINE] + weights[2] * details[_POINTS]
    known = weights[0] * (1 - unseen)
    model = known * sums[APPEARANCE] + weights[1] * sums[OUTLINE] + weights[2] * sums[POINTS]
    return EvaluatedPose(cost, R, t, details, model[:6, :6].copy(), model[6, :6])


_fit = pose_minimizer(_evaluate, 2.3e-308)


@kernel(void(SURFACE, TARGET, MATCHES, SCALES, float64[::1], int64, _POSES, int64, int64))
def _minimize(surface, target, matches, scales, weights, steps, poses, first, last):
    buffers = drawing_buffers(surface.vertices, target.comparable)
    frame = _Frame(surface, target, matches, scales, weights, buffers)
    for n in range(first, last):
        best, tried = _fit(frame, _evaluate(frame, poses.R[n], poses.t[n]), _DAMPING, steps)
        poses.cost[n], poses.tried[n] = best.cost, tried
        poses.R[n], poses.t[n], poses.details[n] = best.R, best.t, best.details
        poses.matrix[n], poses.gradient[n] = best.matrix, best.gradient
