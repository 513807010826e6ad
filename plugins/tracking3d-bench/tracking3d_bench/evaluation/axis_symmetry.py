"""Rotation errors of objects of revolution: the rotation about their axis is not observable and does not count.

What is left of a rotation ``R`` is where it takes the axis: ``R a``, with the unit vector ``a`` in true object
coordinates. In estimated ones the axis is an unknown ``b``. The error of a frame is the angle between ``R_est b`` and
``R_true a``, as BOP's symmetric measures take the least over all turns about the axis. Angles are in degrees.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d_bench.evaluation.arrays import finite
from tracking3d_bench.evaluation.metrics import Angles, Rotations

_STEPS = 100
_STARTS = 100


def aligned_axis_errors(R_est: Rotations, R_true: Rotations, axis: ArrayLike) -> Angles:
    """Error of every frame with the ``b`` of the least sum of errors, the robust median on the sphere.

    Weiszfeld steps from the best of the frames' own estimates, as in `tracking3d_bench.evaluation.metrics`.

    Args:
        R_est, R_true: ``(N, 3, 3)``.
        axis: ``(3,)`` in true object coordinates.

    Raises:
        ValueError: If there is no frame, the shapes differ or the axis has no direction.
    """
    seen = _axes_as_estimated(R_est, R_true, axis)
    starts = seen[np.unique(np.linspace(0, len(seen) - 1, _STARTS).round().astype(int))]
    best = starts[np.argmin([_angles(start, seen).sum() for start in starts])]
    return _angles(_median(best, seen), seen)


def anchored_axis_errors(R_est: Rotations, R_true: Rotations, axis: ArrayLike) -> Angles:
    """Error ``(N,)`` with the ``b`` under which the first frame, whose own error is 0, is right.

    Raises:
        ValueError: As `aligned_axis_errors`.
    """
    seen = _axes_as_estimated(R_est, R_true, axis)
    return _angles(seen[0], seen)


def consecutive_axis_errors(R_est: Rotations, R_true: Rotations, axis: ArrayLike) -> Angles:
    """Error ``(N - 1,)`` of each frame with the ``b`` under which the frame before is right.

    Raises:
        ValueError: As `aligned_axis_errors`.
    """
    seen = _axes_as_estimated(R_est, R_true, axis)
    return np.array([_angles(one, other[None])[0] for one, other in pairwise(seen)])


def tilts(R_est: Rotations, axes: NDArray[np.float64], R_true: Rotations, axis: ArrayLike) -> Angles:
    """Angle ``(N,)`` between estimated axes ``(N, 3)``, whose ends are not told apart, and the true one.

    Args:
        R_est, R_true: ``(N, 3, 3)``.
        axes: In estimated object coordinates.
        axis: ``(3,)`` in true object coordinates.
    """
    seen = np.einsum("nij,nj->ni", R_est, axes)
    true = R_true @ finite("axis", axis, 3)
    across = np.linalg.norm(np.cross(seen, true), axis=1)
    return np.degrees(np.arctan2(across, np.abs(np.einsum("ni,ni->n", seen, true))))


def _axes_as_estimated(R_est: Rotations, R_true: Rotations, axis: ArrayLike) -> NDArray[np.float64]:
    """``(N, 3)`` unit vectors: the true axis in estimated object coordinates, by every frame."""
    if R_est.shape != R_true.shape or R_est.ndim != 3 or not len(R_est):
        raise ValueError(
            f"rotations need equal shapes (N, 3, 3) with N > 0, got {R_est.shape} and {R_true.shape}"
        )
    a = finite("axis", axis, 3)
    length = np.linalg.norm(a)
    if length == 0:
        raise ValueError("the axis has the length 0, so no direction")
    return np.einsum("nji,njk,k->ni", R_est, R_true, a / length)


def _angles(one: NDArray[np.float64], others: NDArray[np.float64]) -> Angles:
    """Angles ``(N,)`` between a unit vector ``(3,)`` and others ``(N, 3)``, exact for small ones too."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(others, one), axis=1), others @ one))


def _median(start: NDArray[np.float64], seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Iteratively reweighted mean of ``seen`` ``(N, 3)`` in the tangent plane, from ``start``."""
    b = start
    for _ in range(_STEPS):
        across = seen - (seen @ b)[:, None] * b
        length = np.linalg.norm(across, axis=1)
        angle = np.arctan2(length, seen @ b)
        weights = 1 / np.maximum(angle, 1e-9)
        logs = across * (angle / np.maximum(length, 1e-12))[:, None]
        step = weights @ logs / weights.sum()
        size = np.linalg.norm(step)
        if size < 1e-12:
            break
        b = np.cos(size) * b + np.sin(size) * step / size
        b = b / np.linalg.norm(b)
    return b
