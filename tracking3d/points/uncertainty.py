"""Predicts the error in pixels of a tracked point.

The logarithm of the error is a sum of logarithms of what is known about the point; the weights were fitted on sequences
of a seed, see ``training/point_uncertainty.py``, and tested on those of another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.points.view import Array

MEASURED = (-1.277, 0.028, 0.229, 0.27, -0.911, 0.498)
PREDICTED = (1.813, 0.417, 0.069, -0.392, 0.097, 0.657)
"""Weights of `error_features`, of points that the image corrected and of those that it did not."""
FEATURES = len(MEASURED)
"""How many there are."""
_UNMEASURED = 1.0  # squared pixels


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known about N points in T views."""

    variance: Array  # (T, N) squared pixels of the measurement; infinite if there is none
    spread: Array  # (N,) mean squared pixels between measurements and the landmark
    views: NDArray[np.int64]  # (N,) in how many views the point was measured
    slant: Array  # (N,) cosine between ray and surface where the point was asked for
    gap: NDArray[np.int64]  # (T,) views from there

    @property
    def measured(self) -> NDArray[np.bool_]:
        """``(T, N)``: whether the image had a say."""
        return np.isfinite(self.variance)


def error_features(evidence: Evidence) -> Array:
    """``(T, N, 6)``: one, and logarithms that are small for points that are known well."""
    shape = evidence.variance.shape
    known = np.where(evidence.measured, evidence.variance, _UNMEASURED)
    parts = (
        np.ones(shape),
        np.log(known + 1e-3),
        np.broadcast_to(np.log(evidence.spread + 1e-2), shape),
        np.broadcast_to(np.log(evidence.views + 1.0), shape),
        np.broadcast_to(np.log(evidence.slant + 0.1), shape),
        np.broadcast_to(np.log(evidence.gap + 1.0)[:, None], shape),
    )
    return np.stack(parts, 2)


def expected_error(evidence: Evidence) -> Array:
    """``(T, N)`` pixels: twice as much holds some 19 of 20 errors."""
    known = error_features(evidence)
    logarithm = np.where(evidence.measured, known @ np.array(MEASURED), known @ np.array(PREDICTED))
    error: Array = np.exp(np.clip(logarithm, -3.0, 5.0))
    return error
