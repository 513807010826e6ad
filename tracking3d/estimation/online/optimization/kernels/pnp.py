"""Kernel of `tracking3d.estimation.online.optimization.pnp`: Levenberg-Marquardt over one pose in one call."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np

from tracking3d.estimation.online.optimization.types import CONVERGED, PnPFit, PointEquations
from tracking3d.estimation.online.optimization.types import PNP_FIRST_DAMPING as FIRST_DAMPING
from tracking3d.estimation.online.optimization.types import PNP_MOST_DAMPING as MOST_DAMPING
from tracking3d.points.bundle_adjustment.kernels.reprojection import (
    factorize,
    pixel_motion,
    rotate_by,
    shared,
    solve_factorised,
    to_camera,
)
from tracking3d.points.bundle_adjustment.reprojection import BEHIND, NEAREST, FloatArray
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
) -> PnPFit:
    """See `tracking3d.estimation.online.optimization.pnp`; ``share`` sums to 1 and is 0 for rows without use."""
    given = (np.ascontiguousarray(part, np.float64) for part in (points, pixels, share, K))
    start = (np.array(part, np.float64, order="C") for part in (R, t))  # written to
    R, t, *equations = _pose_of_tracks(*given, *start, float(scale), iterations)
    return PnPFit(R, t, PointEquations(*equations))


@kernel(
    "Tuple((float64[:,::1], float64[::1], float64[:,::1], float64[::1], float64, float64[::1]))("
    "float64[:,::1], float64[:,::1], float64[::1], float64[:,::1], float64[:,::1], float64[::1], float64, int64)"
)
def _pose_of_tracks(points, pixels, share, K, R, t, scale, iterations):
    matrix, gradient, residual = np.empty((6, 6)), np.empty(6), np.empty(len(points))
    cost = _equations(points, pixels, share, K, R, t, scale, matrix, gradient, residual)
    R_new, t_new, damping = np.empty((3, 3)), np.empty(3), FIRST_DAMPING
    system, step = np.empty((6, 6)), np.empty(6)
    new_matrix, new_gradient, new_residual = np.empty((6, 6)), np.empty(6), np.empty(len(points))
    for _ in range(iterations):
        largest = 0.0
        for row in range(6):
            largest = max(largest, matrix[row, row])
        for row in range(6):
            step[row] = -gradient[row]
            for column in range(6):
                system[row, column] = matrix[row, column]
            system[row, row] += damping * matrix[row, row] + 1e-9 * largest + 1e-12
        new_cost = math.inf
        if factorize(system):
            solve_factorised(system, step)
            rotate_by(step[3], step[4], step[5], R, R_new)
            for row in range(3):
                t_new[row] = t[row] + step[row]
            new_cost = _equations(
                points, pixels, share, K, R_new, t_new, scale, new_matrix, new_gradient, new_residual
            )
        if not new_cost < cost:
            damping = min(10 * damping, MOST_DAMPING)
            continue
        settled = cost - new_cost < CONVERGED * cost
        cost, damping = new_cost, damping / 10
        R, R_new, t, t_new = R_new, R, t_new, t
        matrix, new_matrix, gradient, new_gradient = new_matrix, matrix, new_gradient, gradient
        residual, new_residual = new_residual, residual
        if settled:
            break
    return R, t, matrix, gradient, cost, residual


@shared
def _equations(points, pixels, share, K, R, t, scale, matrix, gradient, residual):
    """Write the normal equations and each point's distance; the mean loss."""
    x_cam, difference = np.empty(3), np.empty(2)
    by_point, by_pose = np.empty((2, 3)), np.empty((2, 6))
    focal = np.array((K[0, 0], K[1, 1]))
    cost = 0.0
    for i in range(6):
        gradient[i] = 0.0
        for j in range(6):
            matrix[i, j] = 0.0
    for n in range(len(points)):
        residual[n] = math.nan
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
    return cost
