"""Kernels of `optimization.pose_refinement` and `optimization.pnp`: poses of a frame, by all it shows or by points."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numba import float64, int64, void

from tracking3d.estimation.online.optimization.types import (
    NOTHING_SEEN,
    PNP_DAMPING,
    EvaluatedPoses,
    PoseWeights,
)
from tracking3d.geometry.levenberg_marquardt import Damping
from tracking3d.points.bundle_adjustment.kernels.reprojection import (
    pixel_motion,
    pose_minimizer,
    shared,
    to_camera,
)
from tracking3d.points.bundle_adjustment.reprojection import BEHIND, NEAREST, EvaluatedPose, FloatArray
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


_POSES = record(
    EvaluatedPoses,
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
) -> EvaluatedPoses:
    """See `tracking3d.estimation.online.optimization.pose_refinement`."""
    check_comparison(surface, target, matched)
    count = len(R)
    poses = EvaluatedPoses(
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
    return poses


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


def pose_of_tracks(
    points: FloatArray,
    pixels: FloatArray,
    share: FloatArray,
    K: FloatArray,
    R: FloatArray,
    t: FloatArray,
    scale: float,
    iterations: int,
) -> EvaluatedPose:
    """See `tracking3d.estimation.online.optimization.pnp`; ``share`` sums to 1 and is 0 for rows without use."""
    given = (np.ascontiguousarray(part, np.float64) for part in (points, pixels, share, K))
    start = (np.array(part, np.float64, order="C") for part in (R, t))  # may be what is returned
    return EvaluatedPose(*_pose_of_tracks(*given, *start, float(scale), iterations))


class _Tracks(NamedTuple):
    points: FloatArray
    pixels: FloatArray
    share: FloatArray
    K: FloatArray
    scale: float


@shared
def _evaluate_points(tracks, R, t):
    """The pose with its mean loss and each point's distance."""
    points, pixels, share, K, scale = tracks
    matrix, gradient, residual = np.zeros((6, 6)), np.zeros(6), np.full(len(points), math.nan)
    x_cam, difference = np.empty(3), np.empty(2)
    by_point, by_pose = np.empty((2, 3)), np.empty((2, 6))
    focal = np.array((K[0, 0], K[1, 1]))
    cost = 0.0
    for n in range(len(points)):
        if share[n] == 0:
            continue
        to_camera(R, t, points[n], x_cam)
        if not x_cam[2] > NEAREST:
            cost += share[n] * math.log1p(BEHIND**2)
            continue
        for row in range(2):
            difference[row] = x_cam[row] / x_cam[2] * focal[row] + K[row, 2] - pixels[n, row]
        squared = difference[0] ** 2 + difference[1] ** 2
        residual[n] = math.sqrt(squared)
        cost += share[n] * math.log1p(squared / scale**2)
        # The Cauchy loss as weights of least squares: its derivative is 2 r / (scale^2 + r^2).
        pixel_motion(x_cam, t, focal, math.sqrt(2 * share[n] / (scale**2 + squared)), by_point, by_pose)
        for row in range(2):
            root = math.sqrt(2 * share[n] / (scale**2 + squared))
            for i in range(6):
                gradient[i] += by_pose[row, i] * root * difference[row]
                for j in range(i + 1):
                    matrix[i, j] += by_pose[row, i] * by_pose[row, j]
    for i in range(6):
        for j in range(i):
            matrix[j, i] = matrix[i, j]
    return EvaluatedPose(cost, R, t, residual, matrix, gradient)


_fit_points = pose_minimizer(_evaluate_points)


@kernel(
    "Tuple((float64, float64[:,::1], float64[::1], float64[::1], float64[:,::1], float64[::1]))("
    "float64[:,::1], float64[:,::1], float64[::1], float64[:,::1], float64[:,::1], float64[::1], float64, int64)"
)
def _pose_of_tracks(points, pixels, share, K, R, t, scale, iterations):
    tracks = _Tracks(points, pixels, share, K, scale)
    best, _ = _fit_points(tracks, _evaluate_points(tracks, R, t), PNP_DAMPING, iterations)
    return best.cost, best.R, best.t, best.details, best.matrix, best.gradient
