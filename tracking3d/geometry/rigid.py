"""Rigid transforms of files: their numbers are rounded, or come from a calibration that is not quite a rotation."""

from __future__ import annotations

import logging
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ROUNDED = 1e-3
"""Largest entry of ``R R^T - I`` of a rotation that was rounded; chosen, three digits of each number are written."""
NEARLY = 0.02
"""The same of what is replaced by the nearest rotation; chosen. In the truth of a public data set it is .0027."""

_log = logging.getLogger(__name__)


def is_rigid(T: NDArray[np.float64], tolerance: float = ROUNDED) -> bool:
    """Whether ``T`` is a finite ``(4, 4)`` rigid transform."""
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    return bool(np.abs(R @ R.T - np.eye(3)).max() < tolerance and np.linalg.det(R) > 0)


def nearest_rigid(T: NDArray[np.float64], file: Path) -> NDArray[np.float64] | None:
    """The ``(4, 4)`` rigid transform that a file means by ``T``; None if ``T`` is not even nearly one.

    The nearest rotation in the Frobenius norm takes the place of one that is off by more than `ROUNDED`; that is said
    once a file.
    """
    if is_rigid(T):
        return T
    if not is_rigid(T, NEARLY):
        return None
    _say_once(file)
    U, _, V = np.linalg.svd(T[:3, :3])
    T = T.copy()
    T[:3, :3] = U @ V
    return T


@cache
def _say_once(file: Path) -> None:
    _log.warning("%s: some rotations are so only nearly; the nearest ones are used.", file)
