"""What lies around and behind the object: remembered pixel by pixel, and moved as the camera moves.

A running Gaussian average of every pixel outside the mask (Wren et al., "Pfinder: real-time tracking of the human
body", PAMI 1997). What differs from it has come in front of it: a new side of the object, or a hand.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import Window

_RATE = 0.1  # at which a pixel that is known well follows its values
_FAMILIAR = 3.0  # frames until a pixel's memory has full weight
_NOISE, _LEAST_NOISE = (8.0, 3.6)  # standard deviation in grey levels, at first and at least
_CHANGED = 6.0  # squared difference, in variances, at which a pixel may or may not have changed
_UNCHANGED_WEIGHT = 0.5  # what was mistaken for background once does not change either
_STILL = 0.1  # pixels: a camera that moves less stands still, and the memory is not resampled


class BackgroundMemory:
    """The background of one object, in the pixels of the latest frame.

    Args:
        shape: ``(H, W, ...)`` of the frames.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        height, width = shape[:2]
        self._mean = np.zeros((height, width, 3), np.float32)
        self._variance = np.full((height, width), _NOISE**2, np.float32)
        self._frames = np.zeros((height, width), np.float32)

    def move(self, present_to_last: NDArray[np.float64], last: Window, present: Window) -> None:
        """Follow the camera.

        Args:
            present_to_last: ``(3, 3)`` homography from the present crop's pixels to the last crop's.
            last: The last crop.
            present: The present crop.
        """
        matrix = _crop_to_frame(last) @ present_to_last
        matrix = matrix @ np.linalg.inv(_crop_to_frame(present))
        sides = [present.left, present.top], [present.left + present.side, present.top + present.side]
        corners = np.array([sides], np.float64)
        if np.abs(cv2.perspectiveTransform(corners, matrix) - corners).max() < _STILL:
            return
        height, width = self._frames.shape
        self._mean, self._variance, self._frames = (
            cv2.warpPerspective(one, matrix, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            for one in (self._mean, self._variance, self._frames)
        )

    def change(self, image: Image, window: Window) -> NDArray[np.float32]:
        """``(S, S)`` in [-0.5, 1]: has a pixel changed against the background? 0 where that is not known.

        Values between a pixel's neighbours count as its own, so that a memory that is off by a pixel is no change.
        """
        cue = np.zeros((window.side, window.side), np.float32)
        here, within = _overlap(window, self._frames.shape)
        present, mean, frames = (image[here].astype(np.float32), self._mean[here], self._frames[here])
        if not frames.size:
            return np.zeros((window.size, window.size), np.float32)
        square = np.ones((3, 3), np.uint8)
        beyond = np.maximum(present - cv2.dilate(mean, square), cv2.erode(mean, square) - present)
        distance = _mean_square(np.maximum(beyond, 0)) / (self._variance[here] + _LEAST_NOISE**2)
        changed = np.clip(cv2.blur(distance, (3, 3)) / _CHANGED - 1, -1, 1)
        known = np.where(frames < 0.9, 0, np.minimum(frames / _FAMILIAR, 1))
        cue[within] = known * np.where(changed < 0, _UNCHANGED_WEIGHT * changed, changed)
        return cv2.resize(cue, (window.size, window.size), interpolation=_interpolation(window))

    def learn(self, image: Image, window: Window, background: NDArray[np.bool_]) -> None:
        """Remember the pixels of ``image`` that are ``background`` ``(S, S)`` in ``window``."""
        here, within = _overlap(window, self._frames.shape)
        frames, mean, variance = (self._frames[here], self._mean[here], self._variance[here])
        if not frames.size:
            return
        side = (window.side, window.side)
        seen = cv2.resize(background.astype(np.float32), side, interpolation=cv2.INTER_NEAREST)[within]
        rate = seen * np.maximum(1 / (frames + 1), _RATE)
        difference = image[here] - mean
        spread = _mean_square(difference) - variance
        variance += np.where(frames < 0.9, 0, rate) * spread  # the first value tells nothing of the noise
        np.maximum(variance, 4.0, out=variance)
        mean += rate[..., None] * difference
        frames += seen

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Take back what was remembered in ``mask`` ``(H, W)``, which has turned out to be the object."""
        self._frames[mask] = 0


def _mean_square(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Over the channels; several times as fast as squares and means of arrays with three of them."""
    return np.einsum("ijk,ijk->ij", values, values) / values.shape[2]


def _crop_to_frame(window: Window) -> NDArray[np.float64]:
    """``(3, 3)`` from pixels of a crop to those of the frame; centres are at integers in both."""
    step = 1 / window.scale
    left, top = (edge + 0.5 * step - 0.5 for edge in (window.left, window.top))
    return np.array([[step, 0, left], [0, step, top], [0, 0, 1]])


def _overlap(window: Window, shape: tuple[int, ...]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Where the window lies in the frame, and the frame in the window; empty slices where they do not meet."""
    rows, columns = (
        slice(min(max(start, 0), end), max(min(start + window.side, end), 0))
        for start, end in ((window.top, shape[0]), (window.left, shape[1]))
    )
    within = (
        slice(rows.start - window.top, rows.stop - window.top),
        slice(columns.start - window.left, columns.stop - window.left),
    )
    return (rows, columns), within


def _interpolation(window: Window) -> int:
    return cv2.INTER_AREA if window.size < window.side else cv2.INTER_LINEAR
