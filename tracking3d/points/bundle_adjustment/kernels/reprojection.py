"""A point's pixel and its derivatives, small linear systems, and the fit of one pose, for other kernels."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from tracking3d.geometry.levenberg_marquardt import minimizer
from tracking3d.points.bundle_adjustment.reprojection import EvaluatedPose
from tracking3d.rendering.kernels.compilation import OPTIONS

shared = numba.njit(**OPTIONS)


@shared
def to_camera(R, t, point, x_cam):
    """Write a point's camera coordinates ``(3,)``."""
    for row in range(3):
        x_cam[row] = R[row, 0] * point[0] + R[row, 1] * point[1] + R[row, 2] * point[2] + t[row]


@shared
def pixel_motion(x_cam, t, focal, root, by_point, by_pose):
    """Write ``root`` times the derivatives of a pixel by its point ``(2, 3)`` and by the pose's step ``(2, 6)``."""
    inverse = 1 / x_cam[2]
    for row in range(2):
        by_point[row, 1 - row] = 0.0
        by_point[row, row] = root * focal[row] * inverse
        by_point[row, 2] = -root * focal[row] * x_cam[row] * inverse * inverse
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            by_pose[row, i] = by_point[row, i]
            by_pose[row, 3 + i] = (x_cam[j] - t[j]) * by_point[row, k] - (x_cam[k] - t[k]) * by_point[row, j]


@shared
def rotate_by(x, y, z, R, turned):
    """Write ``exp((x, y, z)) R``, by Rodrigues' formula."""
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    if angle > 1e-4:
        a, b = math.sin(angle) / angle, (1 - math.cos(angle)) / squared
    else:
        a, b = 1 - squared / 6, 0.5 - squared / 24
    for column in range(3):
        u, v, w = R[0, column], R[1, column], R[2, column]
        # exp(w) p = p + a w x p + b w x (w x p)
        p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
        turned[0, column] = u + a * p + b * (y * r - z * q)
        turned[1, column] = v + a * q + b * (z * p - x * r)
        turned[2, column] = w + a * r + b * (x * q - y * p)


@shared
def factorize(matrix):
    """Replace the lower triangle of a symmetric matrix by its Cholesky factor; False if there is none."""
    size = len(matrix)
    for i in range(size):
        for j in range(i):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / matrix[j, j]
        total = matrix[i, i]
        for k in range(i):
            total -= matrix[i, k] * matrix[i, k]
        if not total > 0:
            return False
        matrix[i, i] = math.sqrt(total)
    return True


@shared
def solve_factorised(factor, right):
    """Replace ``right`` by the solution of a system whose matrix was factorized."""
    size = len(factor)
    for i in range(size):
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]


@shared
def _model(problem, at):
    return at


def pose_minimizer(evaluate: Callable[..., Any], floor: float = 1e-12) -> Callable[..., Any]:
    """The loop over one pose, see `minimizer`.

    Args:
        evaluate: Makes an `EvaluatedPose` of problem, ``R`` and ``t``.
        floor: What the diagonal has at least.
    """

    @shared
    def step(problem, at, model, damping):
        largest = 0.0
        for row in range(6):
            largest = max(largest, model.matrix[row, row])
        system, moved = model.matrix.copy(), -model.gradient
        for row in range(6):
            system[row, row] += damping * model.matrix[row, row] + 1e-9 * largest + floor
        sound = factorize(system)
        if sound:
            solve_factorised(system, moved)
            sound = np.isfinite(moved).all()
        if not sound:
            return EvaluatedPose(math.inf, at.R, at.t, at.details, at.matrix, at.gradient)
        R = np.empty((3, 3))
        rotate_by(moved[3], moved[4], moved[5], at.R, R)
        return evaluate(problem, R, at.t + moved[:3])

    return shared(minimizer(_model, step))
