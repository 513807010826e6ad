"""From log-odds to a mask whose outline follows the edges of the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.segmentation import SMOOTHER

_SMOOTHNESS, _EDGES = 100.0, 12.0


def along_edges(image: NDArray[np.uint8], log_odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """``(S, S)`` in [-1, 1], positive inside the object: log-odds carried along where the image has no edges.

    Weighted least squares by Min et al., "Fast global image smoothing based on weighted least squares", 2014, in
    OpenCV; without OpenCV's extra modules the log-odds decide alone.

    Args:
        image: ``(S, S, 3)`` RGB.
        log_odds: ``(S, S)``.
    """
    support = np.tanh(log_odds / 2).astype(np.float32)
    if why_no_contrib(SMOOTHER):
        return support
    return np.asarray(cv2.ximgproc.fastGlobalSmootherFilter(image, support, _SMOOTHNESS, _EDGES), np.float32)
