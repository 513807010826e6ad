"""How many pixels a point that the images alone follow is off, as far as that can be told beforehand.

As in `tracking3d.points.uncertainty`: the logarithm of the error is a sum of logarithms; ``training/
image_point_uncertainty.py`` fitted the weights on clips of some seeds and tested them on those of others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from tracking3d.points.view import Array

FOUND = (1.969, 0.939, 0.692, 0.0)
NOT_FOUND = (0.776, 0.288, 0.27, 0.342)
"""Weights of `image_error_features`, of points that were found in a frame and of those that were not."""
_MOST = 3.5  # logarithm of the pixels beyond which nothing is known at all


def image_error_features(variance: ArrayLike, gap: ArrayLike, hidden: ArrayLike) -> Array:
    """``(..., 4)``: one, and logarithms of what makes points be known badly.

    Args:
        variance: Squared pixels of all placements on the way from the question.
        gap: Frames from there.
        hidden: Frames since the point was last found.
    """
    parts = np.broadcast_arrays(
        1.0, np.log(np.asarray(variance) + 1e-2), np.log1p(np.asarray(gap)), np.log1p(np.asarray(hidden))
    )
    return np.stack(parts, -1)


def expected_image_error(variance: ArrayLike, gap: ArrayLike, hidden: ArrayLike) -> Array:
    """Pixels: twice as much holds some 19 of 20 errors; arguments as of `image_error_features`."""
    known = image_error_features(variance, gap, hidden)
    logarithm = np.where(np.asarray(hidden) > 0, known @ np.array(NOT_FOUND), known @ np.array(FOUND))
    error: Array = np.exp(np.clip(logarithm, -3.0, _MOST))
    return error
