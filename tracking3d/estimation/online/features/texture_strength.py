"""Whether an object has enough texture for points to be tracked.

An untextured object has corners too: shading, highlights and edges. They slide over the surface as it rotates, and
poses that explain them are wrong, however well they fit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

PLAIN = 0.7
"""Strength below which points are not reliable. It lies between the plain and faint textures of the suites ``fresh`` of
seeds 501 and 9101 (up to 0.66) and the others (from 0.77). Real objects in real light have 3 and more."""
_SIZE = 100.0  # pixels to which the object is reduced, so that the strength does not depend on the image resolution
_EDGE = 9  # width in pixels of the band along the outline that is left out, both sides together
_SMOOTHING = 1.5  # pixels; noise of 4 grey levels then adds 0.3
_BLOCK = 7


def texture_strength(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> float:
    """The median, inside the object, of the smaller eigenvalue of the structure tensor, in squared grey levels.

    It is the corner measure of Shi and Tomasi ("Good features to track", CVPR 1994): small in uniform regions, and
    along an edge, at which the image changes in one direction only.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` of the object.

    Returns:
        The strength; 0 if the mask has no interior.
    """
    area = int(np.count_nonzero(mask))
    if area == 0:
        return 0.0
    shrink = min(1.0, _SIZE / math.sqrt(area))
    smooth, inside = image.astype(np.float32), mask.astype(np.uint8)
    if shrink < 1.0:
        smooth = cv2.resize(smooth, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        inside = cv2.resize(inside, smooth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    smooth = cv2.GaussianBlur(smooth, (0, 0), _SMOOTHING)
    inside = cv2.erode(
        inside, np.ones((_EDGE, _EDGE), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    if not inside.any():
        return 0.0
    return float(np.median(cv2.cornerMinEigenVal(smooth, _BLOCK, ksize=3)[inside > 0]))


def has_texture(strengths: Sequence[float]) -> bool:
    """Whether an object with these strengths in some frames has enough texture for its points to be reliable."""
    return bool(strengths) and float(np.median(strengths)) >= PLAIN
