"""Metrics of masks and rotations against ground truth.

The object frames of estimate and truth differ by one unknown rotation ``A``: ``R_true = R_est A``. Rotations
map object to camera. All angles are in degrees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Rotations = NDArray[np.float64]
"""``(N, 3, 3)`` rotation matrices."""

Angles = NDArray[np.float64]
"""``(N,)`` degrees in [0, 180]."""

GOOD_ROTATION = 5.0
"""A frame's rotation counts as right below this many degrees."""

_CANDIDATES = 100
_REFINED = 5
_STEPS = 100


def mask_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two ``(H, W)`` masks; 1 if both are empty, which is agreement."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def rotation_alignment(R_est: Rotations, R_true: Rotations) -> NDArray[np.float64]:
    """The ``(3, 3)`` rotation ``A`` with the least sum of angles between ``R_est A`` and ``R_true``.

    That is the geodesic L1 median of ``R_est^T R_true``, robust to a minority of wrong frames. It has local
    minima, so the frames' own estimates are the starts and Weiszfeld steps on SO(3) refine the best of them
    (Hartley, Aftab and Trumpf, "L1 rotation averaging using the Weiszfeld algorithm", CVPR 2011).

    Raises:
        ValueError: If there is no frame, or the shapes differ.
    """
    offsets = _transposed_product(R_est, R_true)
    spread = np.unique(np.linspace(0, len(offsets) - 1, _CANDIDATES).round().astype(int))
    starts = [offsets[int(n)] for n in spread]
    costs = np.array([_magnitudes(start, offsets).sum() for start in starts])
    best = [starts[n] for n in np.argsort(costs, kind="stable")[:_REFINED]]
    # A start is kept as it is too: refinement only comes near the minimum if that is one of the frames.
    candidates = best + [_weiszfeld(start, offsets) for start in best]
    return min(candidates, key=lambda A: _magnitudes(A, offsets).sum()).as_matrix()


def aligned_rotation_errors(R_est: Rotations, R_true: Rotations) -> Angles:
    """Angle between ``R_est A`` and ``R_true`` in every frame, with ``A`` of `rotation_alignment`.

    Raises:
        ValueError: If there is no frame, or the shapes differ.
    """
    A = rotation_alignment(R_est, R_true)
    return np.degrees(_transposed_product(R_est @ A, R_true).magnitude())


def anchored_rotation_errors(R_est: Rotations, R_true: Rotations) -> Angles:
    """Error of ``R_n R_0^T``, the turn since the first frame; it shows drift and inherits that frame's error.

    The first frame's own error, which is 0, is among the ``(N,)``.

    Raises:
        ValueError: If there is no frame, or the shapes differ.
    """
    return np.degrees(_transposed_product(R_est @ R_est[0].T, R_true @ R_true[0].T).magnitude())


def consecutive_rotation_errors(R_est: Rotations, R_true: Rotations) -> Angles:
    """Error ``(N - 1,)`` of the turn from each frame to the next.

    Raises:
        ValueError: If there are fewer than two frames, or the shapes differ.
    """
    turns = [R[1:] @ R[:-1].transpose(0, 2, 1) for R in (R_est, R_true)]
    return np.degrees(_transposed_product(*turns).magnitude())


def share_under(errors: Angles, limit: float = GOOD_ROTATION) -> float:
    """Share of ``errors`` ``(N,)`` strictly below ``limit``."""
    return float(np.mean(np.asarray(errors) < limit))


def _transposed_product(a: Rotations, b: Rotations) -> Rotation:
    """``a_n^T b_n`` for every n."""
    if a.shape != b.shape or a.ndim != 3 or not len(a):
        raise ValueError(f"rotations need equal shapes (N, 3, 3) with N > 0, got {a.shape} and {b.shape}")
    return Rotation.from_matrix(a).inv() * Rotation.from_matrix(b)


def _magnitudes(A: Rotation, offsets: Rotation) -> NDArray[np.float64]:
    """Angles between ``A`` and each offset, in radians."""
    return (A.inv() * offsets).magnitude()


def _weiszfeld(start: Rotation, offsets: Rotation) -> Rotation:
    """Iteratively reweighted mean of ``offsets`` in the tangent space, from ``start``."""
    A = start
    for _ in range(_STEPS):
        steps = (A.inv() * offsets).as_rotvec()
        weights = 1 / np.maximum(np.linalg.norm(steps, axis=1), 1e-9)
        step = weights @ steps / weights.sum()
        A = A * Rotation.from_rotvec(step)
        if np.linalg.norm(step) < 1e-12:
            break
    return A
