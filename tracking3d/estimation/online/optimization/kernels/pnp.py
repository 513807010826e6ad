"""Kernel of `tracking3d.estimation.online.optimization.pnp`: one pose is fitted in one call."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tracking3d.estimation.online.optimization.types import PNP_DAMPING
from tracking3d.points.bundle_adjustment.kernels.reprojection import (
    pixel_motion,
    pose_minimizer,
    shared,
    to_camera,
)
from tracking3d.points.bundle_adjustment.reprojection import BEHIND, NEAREST, EvaluatedPose, FloatArray
from tracking3d.rendering.kernels.compilation import kernel


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
def _evaluate(tracks, R, t):
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


_minimize = pose_minimizer(_evaluate)


@kernel(
    "Tuple((float64, float64[:,::1], float64[::1], float64[::1], float64[:,::1], float64[::1]))("
    "float64[:,::1], float64[:,::1], float64[::1], float64[:,::1], float64[:,::1], float64[::1], float64, int64)"
)
def _pose_of_tracks(points, pixels, share, K, R, t, scale, iterations):
    tracks = _Tracks(points, pixels, share, K, scale)
    best, _ = _minimize(tracks, _evaluate(tracks, R, t), PNP_DAMPING, iterations)
    return best.cost, best.R, best.t, best.details, best.matrix, best.gradient
