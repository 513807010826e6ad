"""Metrics of masks and rotations against ground truth.

The object frames of estimate and truth differ by one unknown rotation ``A``: ``R_true = R_est A``. Rotations
map object to camera. All angles are in degrees.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.alignment import Rotations, rotation_alignment, transposed_product

Angles = NDArray[np.float64]
"""``(N,)`` degrees in [0, 180]."""

GOOD_ROTATION = 5.0
"""A frame's rotation counts as right below this many degrees."""


def mask_iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    """Intersection over union of two ``(H, W)`` masks; 1 if both are empty, which is agreement."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 1.0


def aligned_rotation_errors(R_est: Rotations, R_true: Rotations) -> Angles:
    """Angle between ``R_est A`` and ``R_true`` in every frame, with ``A`` of `rotation_alignment`.

    Raises:
        ValueError: If there is no frame, or the shapes differ.
    """
    A = rotation_alignment(R_est, R_true)
    return np.degrees(transposed_product(R_est @ A, R_true).magnitude())


def anchored_rotation_errors(R_est: Rotations, R_true: Rotations) -> Angles:
    """Error of ``R_n R_0^T``, the turn since the first frame; it shows drift and inherits that frame's error.

    The first frame's own error, which is 0, is among the ``(N,)``.

    Raises:
        ValueError: If there is no frame, or the shapes differ.
    """
    return np.degrees(transposed_product(R_est @ R_est[0].T, R_true @ R_true[0].T).magnitude())


def consecutive_rotation_errors(R_est: Rotations, R_true: Rotations) -> Angles:
    """Error ``(N - 1,)`` of the turn from each frame to the next.

    Raises:
        ValueError: If there are fewer than two frames, or the shapes differ.
    """
    turns = [R[1:] @ R[:-1].transpose(0, 2, 1) for R in (R_est, R_true)]
    return np.degrees(transposed_product(*turns).magnitude())


def share_under(errors: Angles, limit: float = GOOD_ROTATION) -> float:
    """Share of ``errors`` ``(N,)`` strictly below ``limit``."""
    return float(np.mean(np.asarray(errors) < limit))
