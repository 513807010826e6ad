"""What travels from the video into the estimator: frames, prompts and masks.

Images are ``(H, W, 3)`` uint8 RGB arrays; pixel (0, 0) is the *centre* of the top-left pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
"""``(H, W, 3)`` uint8 RGB."""

TRACKED_CONFIDENCE = 0.8
"""Confidence from which a frame is `tracked`: the chance that its pose and mask are right is four in five or better."""

OCCLUDER = 64
"""Level of what is in front of the object in the image of a mask, in which the object has 255 and the rest 0."""

Box = tuple[float, float, float, float]
"""``(x, y, width, height)`` in pixels; x and y are the left and upper edge of the box."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One decoded frame.

    Attributes:
        index: Position in the source, counted from 0; it keeps its value when frames are skipped.
        image: ``(H, W, 3)`` uint8 RGB.
        time: Seconds since the start of the video, where known.
        name: What messages call it: a file name, or ``"frame 12"``.
        decoding: Seconds that reading it took, where measured; one object's share, where several are tracked.
        occluder: ``(H, W)`` bool, what is known to be in front of the tracked object; None where nothing is known.
    """

    index: int
    image: Image
    time: float | None = None
    name: str = ""
    decoding: float = 0.0
    occluder: NDArray[np.bool_] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """``(height, width)`` in pixels."""
        return self.image.shape[0], self.image.shape[1]

    @property
    def label(self) -> str:
        """What messages call it, whether it has a name or not."""
        return self.name or f"frame {self.index}"


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that the source could not decode, or whose picture came before; the run goes on without it."""

    index: int
    reason: str
    # index of the frame before whose picture this one repeats to the bit; None if there was nothing to be used
    repeats: int | None = None
    time: float | None = None  # of a repeated picture, as in `Frame`
    name: str = ""  # the same


@dataclass(frozen=True, eq=False)
class Prompt:
    """The object in one frame: the first, or one in which it is given again.

    Attributes:
        box: ``(x, y, width, height)`` in pixels. Always present; the mask's bounding box where a mask was given.
        mask: ``(H, W)`` bool, or None where only a box was given. Where points were given, what an image method makes
            of them.
        points: ``(N, 3)`` float32, where points were given: x, y in pixels, and 1 on the object or 0 beside it.
    """

    box: Box
    mask: NDArray[np.bool_] | None = None
    points: NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class MaskEstimate:
    """A mask tracker's answer for one frame.

    Attributes:
        mask: ``(H, W)`` float32 in [0, 1], full resolution; None where the tracker has no answer for this frame.
        score: The tracker's own confidence in [0, 1].
        reason: Why there is no mask, or why the score is low; one short clause.
        occluder: ``(H, W)`` bool, what is in front of the object or beside it, such as a hand: neither object nor
            background. None where the tracker cannot tell; the network of `segment` is then asked.
        carried: Whether the tracker was not asked, and this is the mask of the frame before, moved with the object.
    """

    mask: NDArray[np.float32] | None
    score: float = 1.0
    reason: str = ""
    occluder: NDArray[np.bool_] | None = None
    carried: bool = False

    @property
    def binary(self) -> NDArray[np.bool_] | None:
        """The mask thresholded at one half, or None."""
        return None if self.mask is None else self.mask >= 0.5

    @property
    def found(self) -> NDArray[np.bool_] | None:
        """The same; None where it is empty, too."""
        binary = self.binary
        return binary if binary is not None and binary.any() else None

    def on(self, frame: Frame) -> Frame:
        """The frame with what this estimate says is in front of the object."""
        return frame if self.occluder is None else replace(frame, occluder=self.occluder)


def pixels(size: tuple[int, int]) -> str:
    """A size ``(height, width)`` as sentences have it, width first."""
    return f"{size[1]} x {size[0]}"


def mask_iou_or_none(a: NDArray[np.bool_], b: NDArray[np.bool_] | None) -> float | None:
    """Intersection over union of two ``(H, W)`` masks; None if one is absent or both are empty."""
    if b is None or not (union := np.count_nonzero(a | b)):
        return None
    return float(np.count_nonzero(a & b) / union)
