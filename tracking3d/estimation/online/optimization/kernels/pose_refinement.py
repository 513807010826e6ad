"""Kernel of the module of the same name in `optimization`: Levenberg-Marquardt over a frame's poses in one call."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np

from tracking3d.bundle_adjustment.kernels.reprojection import (
    factorize,
    rotate_by,
    shared,
    solve_factorised,
)
from tracking3d.bundle_adjustment.reprojection import FloatArray
from tracking3d.estimation.online.optimization.pose_refinement import (
    ENOUGH,
    FIRST_DAMPING,
    LEAST_DAMPING,
    MOST_DAMPING,
    NOTHING_SEEN,
    EvaluatedPoses,
    PoseWeights,
)
from tracking3d.rendering import MatchedPoints, PoseTarget, Surface
from tracking3d.rendering.kernels.compilation import kernel
from tracking3d.rendering.kernels.pose_terms import (
    APPEARANCE,
    BOTH,
    COMPARABLE,
    EITHER,
    KNOWN,
    OUTLINE,
    PACKED,
    POINTS,
    drawing_buffers,
    pack,
    terms_of_pose,
)
from tracking3d.rendering.kernels.threads import share
from tracking3d.rendering.pose_terms import NEAREST_POINT, check_comparison

_COST, _APPEARANCE, _OUTLINE, _POINTS, _OVERLAP, _UNSEEN = range(6)


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
    share(
        _minimize, count, 2, *pack(surface, target, matched),
        np.array([weights.appearance_scale, weights.outline_scale, weights.points_scale]),
        np.array([weights.appearance, weights.outline, weights.points, weights.unseen]),
        NEAREST_POINT, steps, R, t, numbers, matrix, gradient, spent, moved,
    )  # fmt: skip
    cost, appearance, outline, points, overlap, unseen = np.ascontiguousarray(numbers.T)
    return EvaluatedPoses(
        R, t, cost, appearance, outline, points, overlap, unseen, matrix, gradient, spent, moved
    )


@kernel(
    f"void({PACKED}, float64[::1], float64[::1], float64, int64, float64[:,:,::1], float64[:,::1],"
    " float64[:,::1], float64[:,:,::1], float64[:,::1], int64[::1], boolean[::1], int64, int64)"
)
def _minimize(
    vertices, faces, face_uvs, edges, edge_faces, layers, features, comparable, inside, mask, distance, K,
    points, pixels, scales, weights, nearest, steps, R, t, numbers, matrix, gradient, spent, moved, first, last,
):  # fmt: skip
    buffers = drawing_buffers(vertices, comparable)
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
            terms_of_pose(
                vertices, faces, face_uvs, edges, edge_faces, layers, features, comparable, inside, mask,
                distance, K, points, pixels, R32, t32, scales[0], scales[1], scales[2], nearest, buffers, sums,
                counts,
            )  # fmt: skip
            _weigh(sums, counts, mask.size > 0, weights, new_numbers, new_matrix, new_gradient)
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
    """Write the step (v, w) to the damped model's minimum; zero where there is none."""
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
