"""The estimates for tracked points in one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class PointAnswers:
    """N points in one frame, by that frame and those before it."""

    # (N, 2) pixels of the frame; NaN before a point was given, in the background, where the object is
    # lost and behind the camera. Points on the object's mask that no surface covers yet are where the images
    # carry them, and their points are NaN.
    positions: NDArray[np.float64]
    visible: NDArray[np.bool_]  # (N,) bool
    # (N,) pixels; twice as much is meant to hold 19 of 20 errors. NaN if there is no position.
    uncertainty: NDArray[np.float64]
    # (N, 3) in object coordinates, as they are known now; NaN if a point is not known
    points: NDArray[np.float64]
    measured: NDArray[np.bool_]  # (N,) bool: whether the image had a say

    @classmethod
    def unknown(cls, count: int) -> PointAnswers:
        """Nothing is known of ``count`` points."""
        return cls(
            np.full((count, 2), np.nan),
            np.zeros(count, bool),
            np.full(count, np.nan),
            np.full((count, 3), np.nan),
            np.zeros(count, bool),
        )
