"""From log-odds to a mask whose outline follows the edges of the image."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Window
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.segmentation import SMOOTHER

_SMOOTHNESS, _EDGES = 100.0, 12.0
_THIN = 0.03  # of the root of the area: what is thinner is no part of the object
_LEAST_PART = 0.1  # of the largest part's area


def snap_to_edges(
    image: NDArray[np.uint8], log_odds: NDArray[np.float32], share: float = 1.0
) -> NDArray[np.float32]:
    """``(S, S)`` in [-1, 1], positive inside the object: log-odds carried along where the image has no edges.

    Weighted least squares by Min et al., "Fast global image smoothing based on weighted least squares", 2014, in
    OpenCV; without OpenCV's extra modules the log-odds decide alone.

    Args:
        image: ``(S, S, 3)`` RGB.
        log_odds: ``(S, S)``.
        share: How far the image has to be asked, see `tracking3d.estimation.segmentation.image_weight`.
    """
    support = np.tanh(log_odds / 2).astype(np.float32)
    if why_no_contrib(SMOOTHER):
        return support
    smoothness = share**2 * _SMOOTHNESS
    return np.asarray(cv2.ximgproc.fastGlobalSmootherFilter(image, support, smoothness, _EDGES), np.float32)


def clean_mask(support: NDArray[np.float32]) -> NDArray[np.float32]:
    """The same without hairs and crumbs: where the background has the object's colours, outlines fray."""
    mask = (support > 0).astype(np.uint8)
    side = 2 * round(_THIN / 2 * math.sqrt(np.count_nonzero(mask))) + 1
    if side > 1:
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, disc)
    _, part, statistics, _ = cv2.connectedComponentsWithStats(mask)
    area = statistics[1:, cv2.CC_STAT_AREA]
    large = 1 + np.flatnonzero(area >= _LEAST_PART * area.max(initial=0))
    return np.where(np.isin(part, large), support, -np.abs(support)).astype(np.float32)


def paste_window(
    support: NDArray[np.float32], window: Window, beyond: NDArray[np.float32]
) -> NDArray[np.float32]:
    """``(H, W)`` support in the frame: the window's ``(S, S)``, and that ``beyond`` it ``(H, W)``."""
    shape, full = beyond.shape, beyond.copy()
    region = cv2.resize(support, (window.side, window.side), interpolation=cv2.INTER_LINEAR)
    x0, y0 = max(window.left, 0), max(window.top, 0)
    x1, y1 = min(window.left + window.side, shape[1]), min(window.top + window.side, shape[0])
    if x1 > x0 and y1 > y0:
        full[y0:y1, x0:x1] = region[y0 - window.top : y1 - window.top, x0 - window.left : x1 - window.left]
    return full
