"""Exact distance of pixels to the nearest pixel of a set."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def pixel_distance(pixels: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Euclidean distance of every pixel to the nearest one of a set, in pixels, correctly rounded.

    The last bits of OpenCV's exact transform depend on where the image lies in memory, so two equal runs would differ.
    The squared distances are whole numbers, which are rounded before the root is taken again; that is exact up to
    distances of about 1,000 pixels.

    Args:
        pixels: ``(H, W)``, the set.

    Returns:
        ``(H, W)``, 0 at the pixels of the set. If the set is empty, ``H + W`` everywhere, more than any distance.
    """
    if not pixels.any():
        return np.full(pixels.shape, sum(pixels.shape), np.float32)
    distance = cv2.distanceTransform((~pixels).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.sqrt(np.rint(np.square(distance)))
