"""Kernels of `tracking3d.bundle_adjustment.adjustment`: residuals and normal equations."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, void

from tracking3d.bundle_adjustment.kernels.reprojection import pixel_motion, shared, to_camera
from tracking3d.bundle_adjustment.reprojection import BEHIND, NEAREST, FloatArray
from tracking3d.rendering.kernels.compilation import kernel, record


class BundleArrays(NamedTuple):
    """F frames and N points as kernels take them, float64 and contiguous.

    Attributes:
        pixels: ``(F, N, 2)`` and
        weight: ``(F, N)`` of the observations.
        K: ``(3, 3)``.
        R: ``(F, 3, 3)`` and
        t: ``(F, 3)`` of the poses.
        points: ``(N, 3)``.
    """

    pixels: FloatArray
    weight: FloatArray
    K: FloatArray
    R: FloatArray
    t: FloatArray
    points: FloatArray


class BundleEquations(NamedTuple):
    """Normal equations of C unknowns of the poses and N points; written to."""

    poses: FloatArray  # (C, C)
    points: FloatArray  # (N, 3, 3)
    coupling: FloatArray  # (N, 3, C)
    poses_gradient: FloatArray  # (C,)
    points_gradient: FloatArray  # (N, 3)


_BUNDLE = record(
    BundleArrays,
    float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1],
)  # fmt: skip
_EQUATIONS = record(
    BundleEquations,
    float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[::1], float64[:, ::1],
)  # fmt: skip


def evaluate(
    pixels: FloatArray,
    weight: FloatArray,
    K: FloatArray,
    R: FloatArray,
    t: FloatArray,
    points: FloatArray,
    scale: float,
) -> tuple[float, FloatArray]:
    """The sum of weighted losses, and ``(F, N)`` residuals; nan if nothing is seen."""
    residual = np.empty(weight.shape)
    return float(_evaluate(_pack(pixels, weight, K, R, t, points), float(scale), residual)), residual


def linearize(
    pixels: FloatArray,
    weight: FloatArray,
    K: FloatArray,
    R: FloatArray,
    t: FloatArray,
    points: FloatArray,
    scale: float,
    fixed: int,
    free_focal: bool,
) -> BundleEquations:
    """Blocks of the normal equations as `tracking3d.bundle_adjustment.adjustment` has them, without the prior's."""
    many, size = len(points), 6 * (len(R) - fixed) + free_focal
    equations = BundleEquations(
        np.zeros((size, size)),
        np.zeros((many, 3, 3)),
        np.zeros((many, 3, size)),
        np.zeros(size),
        np.zeros((many, 3)),
    )
    bundle = _pack(pixels, weight, K, R, t, points)
    _linearise(bundle, float(scale), fixed, free_focal, equations)
    return equations


def _pack(*arrays: FloatArray) -> BundleArrays:
    return BundleArrays(*(np.ascontiguousarray(array, np.float64) for array in arrays))


@kernel(float64(_BUNDLE, float64, float64[:, ::1]))
def _evaluate(bundle, scale, residual):
    pixels, weight, K, R, t, points = bundle
    total, x_cam, difference = 0.0, np.empty(3), np.empty(2)
    for f in range(len(R)):
        for n in range(len(points)):
            residual[f, n] = math.nan
            if weight[f, n] == 0:
                continue
            to_camera(R[f], t[f], points[n], x_cam)
            squared = _difference(x_cam, K, pixels[f, n], difference)
            if math.isfinite(squared):
                residual[f, n] = math.sqrt(squared)
                total += weight[f, n] * math.log1p(squared / scale**2)
            else:
                total += weight[f, n] * math.log1p(BEHIND**2)
    return total


@shared
def _difference(x_cam, K, pixel, difference):
    """Write projection less pixel; its square, infinite for a point that has no image."""
    if not x_cam[2] > NEAREST:
        return math.inf
    for row in range(2):
        difference[row] = x_cam[row] / x_cam[2] * K[row, row] + K[row, 2] - pixel[row]
    return difference[0] ** 2 + difference[1] ** 2


@kernel(void(_BUNDLE, float64, int64, boolean, _EQUATIONS))
def _linearise(bundle, scale, fixed, free_focal, equations):
    pixels, weight, K, R, t, points = bundle
    poses, blocks, coupling, poses_gradient, points_gradient = equations
    x_cam, difference, focal = np.empty(3), np.empty(2), np.array((K[0, 0], K[1, 1]))
    by_point, by_pose, by_point_obj = np.empty((2, 3)), np.empty((2, 6)), np.empty((2, 3))
    last = len(poses) - 1
    for f in range(len(R)):
        first = 6 * (f - fixed)
        for n in range(len(points)):
            if weight[f, n] == 0:
                continue
            to_camera(R[f], t[f], points[n], x_cam)
            squared = _difference(x_cam, K, pixels[f, n], difference)
            if not math.isfinite(squared):
                continue
            # The Cauchy loss as weights of least squares: its derivative is 2 r / (scale^2 + r^2).
            root = math.sqrt(2 * weight[f, n] / (scale**2 + squared))
            pixel_motion(x_cam, t[f], focal, root, by_point, by_pose)
            for row in range(2):
                residual = root * difference[row]
                for i in range(3):
                    by_point_obj[row, i] = (
                        by_point[row, 0] * R[f, 0, i]
                        + by_point[row, 1] * R[f, 1, i]
                        + by_point[row, 2] * R[f, 2, i]
                    )
                for i in range(3):
                    points_gradient[n, i] += by_point_obj[row, i] * residual
                    for j in range(3):
                        blocks[n, i, j] += by_point_obj[row, i] * by_point_obj[row, j]
                if f >= fixed:
                    for i in range(6):
                        poses_gradient[first + i] += by_pose[row, i] * residual
                        for j in range(6):
                            poses[first + i, first + j] += by_pose[row, i] * by_pose[row, j]
                        for j in range(3):
                            coupling[n, j, first + i] += by_pose[row, i] * by_point_obj[row, j]
                if free_focal:
                    # Depths go with the focal length: to first order the image of the object's origin plane stays.
                    by_focal = root * x_cam[row] / x_cam[2] * focal[row] + by_point[row, 2] * t[f, 2]
                    poses[last, last] += by_focal * by_focal
                    poses_gradient[last] += by_focal * residual
                    for j in range(3):
                        coupling[n, j, last] += by_point_obj[row, j] * by_focal
                    if f >= fixed:
                        for i in range(6):
                            poses[last, first + i] += by_pose[row, i] * by_focal
                            poses[first + i, last] += by_pose[row, i] * by_focal
