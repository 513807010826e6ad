"""Kernels of `tracking3d.points.bundle_adjustment.adjustment`: residuals and normal equations."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, void

from tracking3d.points.bundle_adjustment.kernels.reprojection import (
    factorize,
    pixel_motion,
    shared,
    solve_factorised,
    to_camera,
)
from tracking3d.points.bundle_adjustment.reprojection import BEHIND, NEAREST, FloatArray
from tracking3d.rendering.kernels.compilation import kernel, record, share


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
    """Blocks of the normal equations as `tracking3d.points.bundle_adjustment.adjustment` has them, without the
    prior's."""
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


# Kernels of a bundle adjustment step: the Schur complement of the points, the poses' step, back-substitution.
#
# The products that this takes are nearly all of its work. They are taken in tiles that stay in the processor's nearest
# memory, each entry's sum in ascending order, so that neither tiles nor threads change a digit.


_TERMS, _COLUMNS = 48, 32
"""Of a tile of a factor: 12 KB. All of its columns are always computed, since the compiler then knows how many."""
_LEAST_BLOCKS = 8  # of rows; below, another thread does not pay


def step(
    poses: FloatArray,
    points: FloatArray,
    coupling: FloatArray,
    poses_gradient: FloatArray,
    points_gradient: FloatArray,
) -> tuple[FloatArray, FloatArray] | None:
    """Step of poses ``(C,)`` and points ``(N, 3)`` by damped blocks; None if there is none."""
    size, many = len(poses), len(points)
    reduced, factors = poses.copy(), points.copy()
    by_points = np.empty((3 * many, size))
    d_poses, d_points = poses_gradient.copy(), points_gradient.copy()
    if not _divide(factors, coupling, points_gradient, by_points, d_poses):
        return None
    _subtract_product(reduced, coupling.reshape(3 * many, size), by_points, 0)
    for first in range(0, size, _TERMS):
        last = min(first + _TERMS, size)
        columns = np.zeros((last - first, size))
        if not _panel(reduced, first, last, columns):
            return None
        _subtract_product(reduced, columns, columns, last)
    return (d_poses, d_points) if _solve(reduced, factors, coupling, d_poses, d_points) else None


@kernel("boolean(float64[:,:,::1], float64[:,:,::1], float64[:,::1], float64[:,::1], float64[::1])")
def _divide(points, coupling, points_gradient, by_points, gradient):
    """Factorise points' blocks, divide by them what couples them, and take the points out of the poses' gradient."""
    along, tile = np.empty(3), np.zeros(3 * _COLUMNS)
    for n in range(len(points)):
        if not factorize(points[n]):
            return False
        for row in range(3):
            along[row] = points_gradient[n, row]
        solve_factorised(points[n], along)
        for i in range(len(gradient)):
            gradient[i] -= (
                coupling[n, 0, i] * along[0] + coupling[n, 1, i] * along[1] + coupling[n, 2, i] * along[2]
            )
        _solve_columns(points[n], coupling[n], by_points[3 * n : 3 * n + 3], tile)
    return True


@shared
def _solve_columns(factor, right, solved, tile):
    """Write the solutions ``(3, C)`` of a system whose matrix was factorized."""
    a, b, c = 1 / factor[0, 0], 1 / factor[1, 1], 1 / factor[2, 2]
    ba, ca, cb = factor[1, 0], factor[2, 0], factor[2, 1]
    for first in range(0, right.shape[1], _COLUMNS):
        last = min(first + _COLUMNS, right.shape[1])
        _fill(tile, right, first, last)
        for i in range(last - first):
            x = tile[i] * a
            y = (tile[_COLUMNS + i] - ba * x) * b
            z = (tile[2 * _COLUMNS + i] - ca * x - cb * y) * c * c
            y = (y - cb * z) * b
            tile[i], tile[_COLUMNS + i], tile[2 * _COLUMNS + i] = (x - ba * y - ca * z) * a, y, z
        for k in range(3):
            for i in range(last - first):
                solved[k, first + i] = tile[k * _COLUMNS + i]


@shared
def _fill(tile, matrix, first, last):
    """Copy columns of a matrix to where the compiler knows how far they are from one another."""
    for k in range(len(matrix)):
        row = matrix[k]
        for j in range(last - first):
            tile[k * _COLUMNS + j] = row[first + j]


def _subtract_product(target: FloatArray, left: FloatArray, right: FloatArray, start: int) -> None:
    """Take ``left.T @ right`` from the lower triangle of ``target``, in the rows and columns from ``start`` on."""
    blocks = (len(target) - start + 5) // 6
    share(_subtract, (blocks + 1) // 2, _LEAST_BLOCKS, target, left, right, start)


@kernel("void(float64[:,::1], float64[:,::1], float64[:,::1], int64, int64, int64)")
def _subtract(target, left, right, start, first, last):
    """A share of the blocks of six rows: as many from the short end of the triangle as from the long one."""
    size, terms = len(target), len(left)
    blocks = (size - start + 5) // 6
    tile, sums = np.zeros(_TERMS * _COLUMNS), np.zeros(6 * _COLUMNS)
    for j in range(start, size, _COLUMNS):
        for k in range(0, terms, _TERMS):
            used = min(_TERMS, terms - k)
            _fill(tile, right[k : k + used], j, min(j + _COLUMNS, size))
            for i in range(first, last):
                _subtract_rows(target, left[k : k + used], start + 6 * i, j, tile, sums)
                if i != blocks - 1 - i:
                    _subtract_rows(target, left[k : k + used], start + 6 * (blocks - 1 - i), j, tile, sums)


@shared
def _subtract_rows(target, left, row, first, tile, sums):
    """A tile's columns of six rows, a frame's; three terms at a time, a point's, which are often nothing."""
    end = len(target) - 1
    # Where there are fewer rows, the last one is computed several times.
    A, B, C = row, min(row + 1, end), min(row + 2, end)
    D, E, F = min(row + 3, end), min(row + 4, end), min(row + 5, end)
    if first > F:
        return
    last, rows = min(first + _COLUMNS, len(target)), (A, B, C, D, E, F)
    for at, each in enumerate(rows):
        for j in range(last - first):
            sums[at * _COLUMNS + j] = target[each, first + j]
    for k in range(0, len(left) - 2, 3):
        x, y, z = left[k], left[k + 1], left[k + 2]
        x0, x1, x2, x3, x4, x5 = x[A], x[B], x[C], x[D], x[E], x[F]
        y0, y1, y2, y3, y4, y5 = y[A], y[B], y[C], y[D], y[E], y[F]
        z0, z1, z2, z3, z4, z5 = z[A], z[B], z[C], z[D], z[E], z[F]
        nothing = x0 == 0 and x1 == 0 and x2 == 0 and x3 == 0 and x4 == 0 and x5 == 0
        nothing = nothing and y0 == 0 and y1 == 0 and y2 == 0 and y3 == 0 and y4 == 0 and y5 == 0
        nothing = nothing and z0 == 0 and z1 == 0 and z2 == 0 and z3 == 0 and z4 == 0 and z5 == 0
        if not nothing:
            for j in range(_COLUMNS):
                p, q, r = tile[k * _COLUMNS + j], tile[(k + 1) * _COLUMNS + j], tile[(k + 2) * _COLUMNS + j]
                sums[j] = sums[j] - x0 * p - y0 * q - z0 * r
                sums[_COLUMNS + j] = sums[_COLUMNS + j] - x1 * p - y1 * q - z1 * r
                sums[2 * _COLUMNS + j] = sums[2 * _COLUMNS + j] - x2 * p - y2 * q - z2 * r
                sums[3 * _COLUMNS + j] = sums[3 * _COLUMNS + j] - x3 * p - y3 * q - z3 * r
                sums[4 * _COLUMNS + j] = sums[4 * _COLUMNS + j] - x4 * p - y4 * q - z4 * r
                sums[5 * _COLUMNS + j] = sums[5 * _COLUMNS + j] - x5 * p - y5 * q - z5 * r
    for k in range(len(left) - len(left) % 3, len(left)):
        for at, each in enumerate(rows):
            for j in range(_COLUMNS):
                sums[at * _COLUMNS + j] -= left[k, each] * tile[k * _COLUMNS + j]
    for at, each in enumerate(rows):
        for j in range(last - first):
            target[each, first + j] = sums[at * _COLUMNS + j]


@kernel("boolean(float64[:,::1], int64, int64, float64[:,::1])")
def _panel(matrix, first, last, columns):
    """Cholesky factor of the columns of a panel, written transposed into ``columns`` too."""
    for j in range(first, last):
        for i in range(j, len(matrix)):
            total = matrix[i, j]
            for k in range(first, j):
                total -= columns[k - first, i] * columns[k - first, j]
            matrix[i, j] = total
        if not matrix[j, j] > 0:
            return False
        root = math.sqrt(matrix[j, j])
        matrix[j, j] = columns[j - first, j] = root
        for i in range(j + 1, len(matrix)):
            matrix[i, j] /= root
            columns[j - first, i] = matrix[i, j]
    return True


@kernel("boolean(float64[:,::1], float64[:,:,::1], float64[:,:,::1], float64[::1], float64[:,::1])")
def _solve(factor, points, coupling, d_poses, d_points):
    """Replace the gradients by the steps; False if they are not finite."""
    solve_factorised(factor, d_poses)
    sound = True
    for i in range(len(d_poses)):
        d_poses[i] = -d_poses[i]
        sound = sound and math.isfinite(d_poses[i])
    for n in range(len(points)):
        for row in range(3):
            total = d_points[n, row]
            for i in range(len(d_poses)):
                total += coupling[n, row, i] * d_poses[i]
            d_points[n, row] = -total
        solve_factorised(points[n], d_points[n])
        for row in range(3):
            sound = sound and math.isfinite(d_points[n, row])
    return sound
