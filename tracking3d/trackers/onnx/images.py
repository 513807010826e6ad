"""Conversion of an image to a network's input, and of what it gives back to pixels and proposed masks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image
from tracking3d.trackers.onnx.description import ImageInput

TRIAL_IMAGE: Image = np.full((256, 256, 3), 90, np.uint8)
"""A bright square in `TRIAL_BOX` on grey: what a network is asked about when it is made."""
TRIAL_BOX = (112, 112, 32, 32)
TRIAL_IMAGE[112:144, 112:144] = 255, 120, 20


@dataclass(frozen=True)
class Letterbox:
    """How an image lies in a network's input.

    All sizes are height and width; ``content`` is what the image takes in the input, from its upper left corner.
    """

    image: tuple[int, int]
    content: tuple[int, int]
    input: tuple[int, int]

    @property
    def scale(self) -> NDArray[np.float32]:
        """``(2,)``: input pixels per image pixel, along x and y."""
        return np.array([self.content[1] / self.image[1], self.content[0] / self.image[0]], np.float32)


def enlarge(box: Box, factor: float, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of ``box`` ``(x, y, w, h)`` enlarged about its centre, within a frame ``(H, W, ...)``.

    At least two pixels are left, also of a box beyond the frame.
    """
    x, y, width, height = box
    return (
        _interval(y + height / 2, factor * height, shape[0]),
        _interval(x + width / 2, factor * width, shape[1]),
    )


def _interval(centre: float, length: float, limit: int) -> slice:
    start = min(max(round(centre - length / 2), 0), max(limit - 2, 0))
    return slice(start, max(min(round(centre + length / 2), limit), min(start + 2, limit)))


def fit_image(size: tuple[int, int], description: ImageInput) -> Letterbox:
    """Where an image of ``size`` ``(H, W)`` goes in the input that ``description`` asks for."""
    match description.size:
        case None:
            return Letterbox(size, size, size)
        case int(side):
            target = (side, side)
        case target:
            pass
    if description.fit == "stretch":
        return Letterbox(size, target, target)
    scale = min(target[0] / size[0], target[1] / size[1])
    content = max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)
    return Letterbox(size, content, target)


def network_input(image: Image, fit: Letterbox, description: ImageInput) -> NDArray[np.float32]:
    """The float32 array that the network takes for ``image`` ``(H, W, 3)``; axes as described."""
    height, width = fit.content
    shrinks = height * width < image.shape[0] * image.shape[1]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    content = cv2.resize(image, (width, height), interpolation=method)
    canvas = np.empty((*fit.input, 3), np.float32)
    canvas[:] = description.padding
    canvas[:height, :width] = content
    divisor = max(float(content.max()), 1.0) if description.divisor == "max" else description.divisor
    mean, std = np.array(description.mean, np.float32), np.array(description.std, np.float32)
    canvas = (canvas / np.float32(divisor) - mean) / std
    if description.channels == "bgr":
        canvas = canvas[..., ::-1]
    if "chw" in description.layout:
        canvas = canvas.transpose(2, 0, 1)
    return np.ascontiguousarray(canvas[None] if "n" in description.layout else canvas)


def on_image(values: NDArray, fit: Letterbox, padded: bool) -> NDArray[np.float32]:
    """Values of a network's output grid ``(h, w)`` at the pixels of the image, ``(H, W)``.

    Args:
        values: The grid.
        fit: How the image lay in the input.
        padded: Whether the grid covers the whole input, or the image alone.
    """
    height, width = fit.image
    grid = np.ascontiguousarray(values, dtype=np.float32)
    if padded:
        grid = cv2.resize(grid, fit.input[::-1], interpolation=cv2.INTER_LINEAR)
        grid = grid[: fit.content[0], : fit.content[1]]
    return cv2.resize(grid, (width, height), interpolation=cv2.INTER_LINEAR)


def sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    """The logistic function, without overflow."""
    return (0.5 * (1.0 + np.tanh(0.5 * logits))).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Proposal:
    """A mask that a network proposes."""

    mask: NDArray[np.float32]  # (H, W) in [0, 1]
    sharpness: float  # how little the mask depends on the threshold, in [0, 1], see `sharpness`
    origin: str  # which crop or prompt it came from


class Segmenter(Protocol):
    """A segmentation network that is given the rough position of the object."""

    def propose(self, image: Image, box: Box, last: NDArray[np.float32] | None) -> list[Proposal]:
        """Masks of the object in ``image`` ``(H, W, 3)`` RGB.

        Args:
            image: The frame.
            box: ``(x, y, w, h)``, where a box tracker sees the object.
            last: ``(H, W)`` in [0, 1], the last mask carried into this frame, or None at the start.
        """
        ...


@runtime_checkable
class PointSegmenter(Protocol):
    """A segmentation network that also takes object and background points."""

    def propose_by_points(self, image: Image, points: NDArray[np.float32]) -> list[Proposal]:
        """Masks of the object in ``image`` ``(H, W, 3)`` RGB.

        Args:
            image: The frame.
            points: ``(N, 3)``: x, y in pixels of the image, and 1 for the object or 0 for the background.
        """
        ...


def sharpness(mask: NDArray[np.float32]) -> float:
    """The area above 0.75 relative to the area above 0.25, in [0, 1]; 0 for an empty mask.

    For logits these are about +1 and -1, the offsets of the stability score of Segment Anything (Kirillov et
    al. 2023).
    """
    wide = int(np.count_nonzero(mask > 0.25))
    return int(np.count_nonzero(mask > 0.75)) / wide if wide else 0.0
