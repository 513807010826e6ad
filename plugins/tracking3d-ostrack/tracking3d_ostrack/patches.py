"""Rectangles of a frame at a fixed size, black beyond its border, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image

_MEAN = np.array([0.485, 0.456, 0.406], np.float32)
_STD = np.array([0.229, 0.224, 0.225], np.float32)


@dataclass(frozen=True)
class Patch:
    """A rectangle of the frame seen at ``size`` x ``size`` pixels.

    Attributes:
        left, top: Its first column and row; it may reach beyond the frame.
        width, height: In frame pixels.
        size: In its own pixels.
    """

    left: int
    top: int
    width: int
    height: int
    size: int

    @classmethod
    def square(cls, box: Box, factor: float, size: int) -> Self:
        """Centred on ``box``, its side ``factor`` times the square root of the box's area (OSTrack)."""
        side = max(math.ceil(factor * math.sqrt(box[2] * box[3])), 1)
        return cls._around(box, side, side, size)

    @classmethod
    def stretch_to(cls, box: Box, factor: float, size: int) -> Self:
        """``factor`` times the box each way, whatever its proportions (AlphaRefine)."""
        width, height = (max(math.ceil(factor * side), 1) for side in box[2:])
        return cls._around(box, width, height, size)

    @classmethod
    def _around(cls, box: Box, width: int, height: int, size: int) -> Self:
        x, y = box[0] + box[2] / 2, box[1] + box[3] / 2
        return cls(round(x - width / 2), round(y - height / 2), width, height, size)

    @property
    def scales(self) -> tuple[float, float]:
        """Patch pixels per frame pixel, across and down."""
        return self.size / self.width, self.size / self.height

    def cut(self, image: Image) -> NDArray[np.float32]:
        """``(1, 3, size, size)``: what it sees, less ImageNet's mean, over its deviation."""
        seen = cv2.warpAffine(image, self._affine, (self.size, self.size), flags=cv2.INTER_LINEAR)
        values = (seen.astype(np.float32) / 255 - _MEAN) / _STD
        return np.ascontiguousarray(values.transpose(2, 0, 1))[None]

    def paste(self, values: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
        """``values`` ``(size, size)`` in a frame of ``shape`` ``(H, W, ...)``, 0 outside the patch."""
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(values.astype(np.float32), self._affine, shape[1::-1], flags=flags)

    def box_in(self, box: Box) -> tuple[float, float, float, float]:
        """A box of the frame in patch pixels, whose origin is the patch's corner."""
        across, down = self.scales
        return (
            (box[0] - self.left) * across,
            (box[1] - self.top) * down,
            box[2] * across,
            box[3] * down,
        )

    def box_out(self, box: Box) -> Box:
        """A box in patch pixels as one of the frame."""
        across, down = self.scales
        return (
            self.left + box[0] / across,
            self.top + box[1] / down,
            box[2] / across,
            box[3] / down,
        )

    @property
    def _affine(self) -> NDArray[np.float64]:
        """``(2, 3)`` from frame to patch pixels; centres of pixels are whole numbers in both."""
        across, down = self.scales
        return np.array(
            [
                [across, 0.0, (0.5 - self.left) * across - 0.5],
                [0.0, down, (0.5 - self.top) * down - 0.5],
            ]
        )
