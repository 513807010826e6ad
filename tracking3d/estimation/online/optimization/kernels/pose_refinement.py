"""Kernel of the module of the same name in `optimization`: Levenberg-Marquardt over a frame's poses in one call."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, void
from numpy.typing import NDArray

from tracking3d.estimation.online.optimization.types import (
    ENOUGH,
    FIRST_DAMPING,
    LEAST_DAMPING,
    MOST_DAMPING,
    NOTHING_SEEN,
    EvaluatedPoses,
    PoseWeights,
)
from tracking3d.points.bundle_adjustment.kernels.reprojection import (
    factorize,
    rotate_by,
    shared,
    solve_factorised,
)
from tracking3d.points.bundle_adjustment.reprojection import FloatArray
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

_COST, _APPEARANCE, _OUTLINE, _POINTS, _OVERLAP, _UNSEEN = range(6)


class PoseArrays(NamedTuple):
    """B poses while they are minimized; written to.

    Attributes:
        R: ``(B, 3, 3)`` and
        t: ``(B, 3)``, where they are.
        numbers: ``(B, 6)`` by the places above: what they cost and why.
        matrix: ``(B, 6, 6)`` and
        gradient: ``(B, 6)`` of the quadratic model there.
        spent: ``(B,)`` evaluations.
        moved: ``(B,)`` whether a step was taken.
    """

    R: FloatArray
    t: FloatArray
    numbers: FloatArray
    matrix: FloatArray
    gradient: FloatArray
    spent: NDArray[np.int64]
    moved: NDArray[np.bool_]


_POSES = record(
    PoseArrays,
    float64[:, :, ::1], float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1], int64[::1],
    boolean[::1],
)  # fmt: skip


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
    R, t = np.array(R, np.float64, order="C"), np.array(t, np.float64, order="C")  # written to
    count = len(R)
    numbers, matrix, gradient = np.empty((count, 6)), np.empty((count, 6, 6)), np.empty((count, 6))
    spent, moved = np.empty(count, np.int64), np.empty(count, np.bool_)
    scales = LossScales(
        *map(float, (weights.appearance_scale, weights.outline_scale, weights.points_scale, NEAREST_POINT))
    )
    share(
        _minimize, count, 2, *packed(surface, target, matched), scales,
        np.array([weights.appearance, weights.outline, weights.points, weights.unseen]), steps,
        PoseArrays(R, t, numbers, matrix, gradient, spent, moved),
    )  # fmt: skip
    cost, appearance, outline, points, overlap, unseen = np.ascontiguousarray(numbers.T)
    return EvaluatedPoses(
        R, t, cost, appearance, outline, points, overlap, unseen, matrix, gradient, spent, moved
    )


@kernel(void(SURFACE, TARGET, MATCHES, SCALES, float64[::1], int64, _POSES, int64, int64))
def _minimize(surface, target, matches, scales, weights, steps, poses, first, last):
    R, t, numbers, matrix, gradient, spent, moved = poses
    buffers = drawing_buffers(surface.vertices, target.comparable)
    R32, t32 = np.empty((3, 3), np.float32), np.empty(3, np.float32)
    sums, counts = np.empty((3, 7, 7)), np.empty(4)
    R_new, t_new, step, system = np.empty((3, 3)), np.empty(3), np.empty(6), np.empty((6, 6))
    new_numbers, new_matrix, new_gradient = np.empty(6), np.empty((6, 6)), np.empty(6)
    for pose in range(first, last):
        damping, spent[pose], moved[pose] = FIRST_DAMPING, 1, False
        for evaluation in range(steps + 1):
            if evaluation == 0:
                R_new[:], t_new[:] = R[pose], t[pose]
            else:
                spent[pose] += 1
                _step(matrix[pose], gradient[pose], damping, system, step)
                rotate_by(step[3], step[4], step[5], R[pose], R_new)
                t_new[:] = t[pose] + step[:3]
            R32[:], t32[:] = R_new, t_new
            sums[:] = 0
            counts[:] = 0
            terms_of_pose(surface, target, matches, R32, t32, scales, buffers, sums, counts)
            _weigh(sums, counts, target.mask.size > 0, weights, new_numbers, new_matrix, new_gradient)
            cost = numbers[pose, _COST]
            gain = math.inf if evaluation == 0 else cost - new_numbers[_COST]
            if gain > 0:
                R[pose], t[pose] = R_new, t_new
                numbers[pose], matrix[pose], gradient[pose] = new_numbers, new_matrix, new_gradient
            if evaluation == 0:
                continue
            if gain > 0:
                moved[pose] = True
                damping = max(damping / 4, LEAST_DAMPING)
                if gain < ENOUGH * cost:
                    break
            else:
                damping *= 8
                if damping > MOST_DAMPING:
                    break


@shared
def _step(matrix, gradient, damping, system, step):
    """Write the step (v, w) to the damped model's minimum; zero if there is none."""
    largest = 0.0
    for row in range(6):
        largest = max(largest, matrix[row, row])
    for row in range(6):
        step[row] = -gradient[row]
        for column in range(6):
            system[row, column] = matrix[row, column]
        system[row, row] += damping * matrix[row, row] + 1e-9 * largest + 2.3e-308
    sound = factorize(system)
    if sound:
        solve_factorised(system, step)
        for row in range(6):
            sound = sound and math.isfinite(step[row])
    if not sound:
        step[:] = 0


@shared
def _weigh(sums, counts, masked, weights, numbers, matrix, gradient):
    """Write what a pose costs, and the model of it; see `tracking3d.estimation.online.optimization.pose_refinement`."""
    nothing = counts[COMPARABLE] == 0
    unseen = 1.0 if nothing else 1 - counts[KNOWN] / counts[COMPARABLE]
    numbers[_UNSEEN] = unseen
    numbers[_APPEARANCE] = (
        sums[APPEARANCE, 6, 6] * (1 - unseen) + weights[3] * unseen + NOTHING_SEEN * nothing
    )
    numbers[_OUTLINE], numbers[_POINTS] = sums[OUTLINE, 6, 6], sums[POINTS, 6, 6]
    numbers[_OVERLAP] = counts[BOTH] / max(counts[EITHER], 1.0) if masked else 1.0
    numbers[_COST] = (
        weights[0] * numbers[_APPEARANCE] + weights[1] * numbers[_OUTLINE] + weights[2] * numbers[_POINTS]
    )
    known = weights[0] * (1 - unseen)
    for i in range(6):
        gradient[i] = (
            known * sums[APPEARANCE, 6, i]
            + weights[1] * sums[OUTLINE, 6, i]
            + weights[2] * sums[POINTS, 6, i]
        )
        for j in range(6):
            matrix[i, j] = (
                known * sums[APPEARANCE, i, j]
                + weights[1] * sums[OUTLINE, i, j]
                + weights[2] * sums[POINTS, i, j]
            )
