"""The background model: learnt per pixel and warped with the camera motion.

A running Gaussian average of every pixel outside the mask (Wren et al., "Pfinder: real-time tracking of the human
body", PAMI 1997). What differs from it has come in front of it: a new side of the object, or a hand. What a mask misses
of the object must not be taken for background: a pixel counts when it lay outside all that may be the object, or has
moved as the background does.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import Window

_RATE = 0.1  # at which a pixel that is known well follows its values
_FAMILIAR = 3.0  # frames until a pixel's memory has full weight
_LASTING = 20.0  # frames that are remembered: as many that contradict them undo it
_NOISE, _LEAST_NOISE = (8.0, 3.6)  # standard deviation in grey levels, at first and at least
_LEAST_VARIANCE = 4.0
_CHANGED = 6.0  # squared difference, in variances, at which a pixel may or may not have changed
_UNCHANGED_WEIGHT = 0.5  # what was mistaken for background once does not change either
_STILL = 0.1  # pixels: a camera that moves less stands still, and the memory is not resampled

_Memory = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]


class BackgroundMemory:
    """The background of one object, in the pixels of the latest frame.

    Args:
        image: ``(H, W, 3)`` RGB, the first frame.
        beside: ``(H, W)`` pixels that are certainly background.

    Attributes:
        stands_still: Whether the camera has not moved so far.
    """

    def __init__(self, image: Image, beside: NDArray[np.bool_]) -> None:
        height, width = beside.shape
        self._mean = image.astype(np.float32)
        self._variance = np.full((height, width), _NOISE**2, np.float32)
        self._frames = beside.astype(np.float32)
        self._proven = beside.astype(np.float32)
        self.stands_still = True
        self._latest: tuple[Image, Window, NDArray[np.float32]] | None = None  # what `change` has found

    def move(
        self,
        present_to_last: NDArray[np.float64],
        last: Window,
        present: Window,
        images: tuple[Image, Image] | None = None,
    ) -> None:
        """Follow the camera.

        Args:
            present_to_last: ``(3, 3)`` homography from the present crop's pixels to the last crop's.
            last: The last crop.
            present: The present crop.
            images: ``(H, W, 3)`` the last and the present frame; a motion of a camera that has stood still is then
                believed only if they agree.
        """
        matrix = _crop_to_frame(last) @ present_to_last
        matrix = matrix @ np.linalg.inv(_crop_to_frame(present))
        sides = [present.left, present.top], [present.left + present.side, present.top + present.side]
        corners = np.array([sides], np.float64)
        if np.abs(cv2.perspectiveTransform(corners, matrix) - corners).max() < _STILL:
            return
        if self.stands_still and images is not None and self._is_nearer_at_rest(matrix, *images):
            return
        self.stands_still = False
        height, width = self._frames.shape
        self._mean, self._variance, self._frames, self._proven = (
            cv2.warpPerspective(one, matrix, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            for one in (self._mean, self._variance, self._frames, self._proven)
        )

    def _is_nearer_at_rest(self, matrix: NDArray[np.float64], last: Image, present: Image) -> bool:
        """Whether the known background of the last frame is nearer to the present one's as it lies than moved.

        What fills most of the crop, as an object that comes in, may be taken for the motion of the camera.
        """
        known = (self._proven > 0.5) & (self._frames >= 0.9)
        if not known.any():
            return False
        before, now = (
            cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (last, present)
        )
        inverse = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpPerspective(
            before, matrix, now.shape[::-1], flags=inverse, borderMode=cv2.BORDER_REPLICATE
        )
        at_rest, in_motion = (np.median(np.abs(one - now)[known]) for one in (before, moved))
        return bool(at_rest <= in_motion)

    def lose(self) -> None:
        """The camera is not followed in this frame; all is forgotten but of one that has stood still so far."""
        if not self.stands_still:
            self._frames[:] = 0

    def change(self, image: Image, window: Window) -> NDArray[np.float32]:
        """``(S, S)`` in [-0.5, 1]: has a pixel changed against the background? 0 if unknown.

        Where the camera has moved there is nothing above 0.

        Values between a pixel's neighbours count as its own, so that a memory that is off by a pixel is no change.
        """
        cue = np.zeros((window.side, window.side), np.float32)
        here, within = _overlap(window, self._frames.shape)
        frames = self._frames[here]
        if not frames.size:
            return np.zeros((window.size, window.size), np.float32)
        difference = self._difference(image, here)
        self._latest = image, window, difference
        changed = np.clip(difference / _CHANGED - 1, -1, 1)
        known = np.where(frames < 0.9, 0, np.minimum(frames / _FAMILIAR, 1)) * self._proven[here]
        if not self.stands_still:  # what lies at another depth changes as the camera moves
            changed = np.minimum(changed, 0)
        cue[within] = known * np.where(changed < 0, _UNCHANGED_WEIGHT * changed, changed)
        return cv2.resize(cue, (window.size, window.size), interpolation=_interpolation(window))

    def unchanged_score(self, image: Image) -> NDArray[np.float32]:
        """``(H, W)`` in [0, 1]: how surely a pixel of the frame is what was seen of the background there."""
        everywhere = (slice(None), slice(None))
        alike = np.clip(1 - self._difference(image, everywhere) / _CHANGED, 0, 1)
        return np.asarray(alike * self._proven * (self._frames >= 0.9), np.float32)

    def learn(
        self, image: Image, window: Window, background: NDArray[np.bool_], proof: NDArray[np.float32]
    ) -> None:
        """Remember pixels of a frame.

        Args:
            image: ``(H, W, 3)`` RGB.
            window: Window of the frame.
            background: ``(S, S)`` which are outside the mask.
            proof: ``(S, S)`` how far this frame proves that they are background, 1 in full; negative where it speaks
                for the object.
        """
        here, within = _overlap(window, self._frames.shape)
        memory = self._mean[here], self._variance[here], self._frames[here], self._proven[here]
        if not memory[0].size:
            return
        side = (window.side, window.side)
        seen = cv2.resize(background.astype(np.uint8), side, interpolation=cv2.INTER_NEAREST)[within] > 0
        proof = cv2.resize(proof, side, interpolation=cv2.INTER_LINEAR)[within]
        latest, self._latest = self._latest, None
        if latest is not None and latest[0] is image and latest[1] == window:
            difference = latest[2]
        else:
            difference = self._difference(image, here)
        learn(image[here], difference < _CHANGED, seen, proof, memory)

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Take back what was remembered in ``mask`` ``(H, W)``, which has turned out to be the object."""
        self._frames[mask] = 0

    def _difference(self, image: Image, here: tuple[slice, slice]) -> NDArray[np.float32]:
        """``(h, w)`` squared difference of a frame's pixels from those remembered ``here``, in variances."""
        return cv2.blur(differences(image[here], self._mean[here], self._variance[here]), (3, 3))


def differences(
    present: NDArray[np.uint8], mean: NDArray[np.float32], variance: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Squared difference of each pixel from its memory, in variances; values between its neighbours' do not differ.

    Args:
        present: ``(h, w, 3)``.
        mean: ``(h, w, 3)`` remembered.
        variance: ``(h, w)``.
    """
    square = np.ones((3, 3), np.uint8)
    highest, lowest = cv2.dilate(mean, square), cv2.erode(mean, square)
    from tracking3d.trackers.kernels import background

    return background.differences(present, highest, lowest, variance, _LEAST_NOISE**2)


def learn(
    present: NDArray[np.uint8],
    familiar: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    proof: NDArray[np.float32],
    memory: _Memory,
) -> None:
    """Take pixels into the memory, in place: new ones as they are, familiar ones slowly, others not.

    Args:
        present: ``(h, w, 3)``.
        familiar: ``(h, w)`` which are as remembered.
        seen: ``(h, w)`` which are outside the mask.
        proof: ``(h, w)`` see `BackgroundMemory.learn`.
        memory: Mean ``(h, w, 3)``, and variance, frames and what is proven ``(h, w)``.
    """
    from tracking3d.trackers.kernels import background

    constants = _RATE, _NOISE**2, _LEAST_VARIANCE, _LASTING
    background.learn(present, familiar, seen, proof, memory, constants)


def _crop_to_frame(window: Window) -> NDArray[np.float64]:
    """``(3, 3)`` from pixels of a crop to those of the frame; centres are at integers in both."""
    step = 1 / window.scale
    left, top = (edge + 0.5 * step - 0.5 for edge in (window.left, window.top))
    return np.array([[step, 0, left], [0, step, top], [0, 0, 1]])


def _overlap(window: Window, shape: tuple[int, ...]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Slices of the window in the frame and of the frame in the window; empty if they do not overlap."""
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
