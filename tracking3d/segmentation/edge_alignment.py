"""How well an outline coincides with image edges along its length."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

_ON, _OFF = 1.0, (3.0, 9.0)
"""Pixels from the outline within which an edge is on it, and between which it is beside it."""
_NEIGHBOURHOOD = 0.15  # half its side, relative to the root of the area
_MOST = 1.5


def edge_strength(lab: NDArray[np.uint8]) -> NDArray[np.float32]:
    """``(S, S)`` how much the colours of a crop ``(S, S, 3)`` in 8-bit Lab change at each pixel, as a root."""
    smooth = cv2.GaussianBlur(lab, (0, 0), 0.8).astype(np.float32)
    total = np.zeros(lab.shape[:2], np.float32)
    for channel in range(3):
        plane = np.ascontiguousarray(smooth[..., channel])
        total += cv2.Sobel(plane, cv2.CV_32F, 1, 0) ** 2 + cv2.Sobel(plane, cv2.CV_32F, 0, 1) ** 2
    strength = np.sqrt(total)
    return np.asarray(np.sqrt(strength / max(float(strength.mean()), 1e-6)), np.float32)


def alignment(edges: NDArray[np.float32], distance: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Log of how strong edges are on an outline over how strong they are beside it.

    Args:
        edges: ``(S, S)`` from `edge_strength`.
        distance: ``(S, S)`` pixels to the outline, positive inside.

    Returns:
        ``(S, S)`` around each pixel, within 1.5, and of the whole outline; 0 if there is no outline.
    """
    area = int(np.count_nonzero(distance > 0))
    if area in (0, distance.size):
        return np.zeros_like(distance), 0.0
    distance = np.abs(distance)
    on, off = (
        (distance <= _ON).astype(np.float32),
        ((distance >= _OFF[0]) & (distance <= _OFF[1])).astype(np.float32),
    )
    side = (2 * max(round(_NEIGHBOURHOOD * math.sqrt(area)), 2) + 1,) * 2
    floor = 0.05
    sums = [cv2.blur(plane, side) for plane in (edges * on, on, edges * off, off)]
    tiny = 1e-4
    known = np.minimum(sums[1] / 0.01, 1.0)
    local = known * np.log((sums[0] / (sums[1] + tiny) + floor) / (sums[2] / (sums[3] + tiny) + floor))
    whole = math.log(
        (float((edges * on).sum()) / max(float(on.sum()), 1) + floor)
        / (float((edges * off).sum()) / max(float(off.sum()), 1) + floor)
    )
    return np.clip(local, -_MOST, _MOST).astype(np.float32), whole
