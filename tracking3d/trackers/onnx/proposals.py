"""Mask proposals of segmentation networks, and their protocol."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Box, Image


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
