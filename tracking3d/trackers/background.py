"""What lies behind and around the object: remembered pixel by pixel, and moved as the camera moves.

A running Gaussian average (Wren et al., "Pfinder", PAMI 1997) of the pixels outside the mask, in the frame's own
pixels. What has changed against it is something that came in front: the object's new side, or a hand.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import Window

_RATE = 0.1
_NOISE = 8.0  # grey levels
_STILL = 0.1


class BackgroundMemory:
    """The background around one object.

    Args:
        image: ``(H, W, 3)`` uint8 RGB, the first frame.
        window: Where to learn.
        background: ``(S, S)`` bool
    """

    def __init__(self, shape) -> None:
        height, width = shape[:2]
        self._mean = np.zeros((height, width, 3), np.float32)
        self._variance = np.full((height, width), _NOISE**2, np.float32)
        self._count = np.zeros((height, width), np.float32)

    def move(self, last_from_present: NDArray[np.float64]) -> None:
        """``(2, 3)`` frame pixels."""
        height, width = self._count.shape
        corners = np.float32([[[0, 0], [width, 0], [0, height], [width, height]]])
        if np.abs(cv2.transform(corners, last_from_present) - corners).max() < _STILL:
            return
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        self._mean = cv2.warpAffine(self._mean, last_from_present, (width, height), flags=flags)
        self._variance = cv2.warpAffine(self._variance, last_from_present, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        self._count = cv2.warpAffine(self._count, last_from_present, (width, height), flags=flags)

    def change(self, image: Image, window: Window) -> NDArray[np.float32]:
        """``(S, S)`` in [-1, 1]."""
        region = self._region(window)
        size = (window.size, window.size)
        out = np.zeros((window.side, window.side), np.float32)
        if region is None:
            return np.zeros(size, np.float32)
        here, inner = region
        ratio = self._distance(image[here], here)
        cue = np.clip(ratio / 6.0 - 1.0, -1, 1) * np.minimum(self._count[here] / 3, 1)
        cue[self._count[here] < 0.9] = 0
        out[inner] = cue
        return cv2.resize(out, size, interpolation=cv2.INTER_AREA if window.size < window.side else cv2.INTER_LINEAR)

    def learn(self, image: Image, window: Window, background: NDArray[np.bool_]) -> None:
        region = self._region(window)
        if region is None:
            return
        here, inner = region
        where = cv2.resize(background.astype(np.uint8), (window.side,) * 2, interpolation=cv2.INTER_NEAREST)[inner]
        count = self._count[here]
        rate = where * np.maximum(1 / (count + 1), _RATE)
        difference = image[here].astype(np.float32) - self._mean[here]
        square = (difference**2).mean(2)
        known = count >= 0.9
        self._variance[here] += np.where(known, rate, 0) * (square - self._variance[here])
        np.maximum(self._variance[here], 4.0, out=self._variance[here])
        self._mean[here] += rate[..., None] * difference
        self._count[here] += where

    def _distance(self, image, here) -> NDArray[np.float32]:
        mean = self._mean[here]
        kernel = np.ones((3, 3), np.uint8)
        above = image - cv2.dilate(mean, kernel)
        below = cv2.erode(mean, kernel) - image
        excess = np.maximum(np.maximum(above, below), 0)
        return cv2.blur((excess**2).mean(2) / (self._variance[here] + 9.0), (3, 3))

    def _region(self, window: Window):
        height, width = self._count.shape
        y0, y1 = max(window.top, 0), min(window.top + window.side, height)
        x0, x1 = max(window.left, 0), min(window.left + window.side, width)
        if x1 <= x0 or y1 <= y0:
            return None
        return np.s_[y0:y1, x0:x1], np.s_[y0 - window.top : y1 - window.top, x0 - window.left : x1 - window.left]
