"""A frame seen through a window: what is there in two dimensions, and where the object is in space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import Window

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FrameCrop:
    """A frame seen through a window of ``(h, w)`` pixels."""

    window: Window  # of the frame
    image: NDArray[Any]  # (h, w, 3) uint8 RGB
    frame_size: tuple[int, int]  # (H, W) of the frame

    @classmethod
    def of(cls, frame: Image, window: Window) -> Self:
        """See ``frame`` ``(H, W, 3)`` RGB through ``window``."""
        return cls(window, crop_window(frame, window), frame.shape[:2])

    @cached_property
    def grey(self) -> NDArray[np.uint8]:
        """``(h, w)``."""
        return cv2.cvtColor(self.image, cv2.COLOR_RGB2GRAY)

    @cached_property
    def lab(self) -> NDArray[np.uint8]:
        """``(h, w, 3)`` 8-bit CIE Lab."""
        return cv2.cvtColor(self.image, cv2.COLOR_RGB2LAB)

    @cached_property
    def in_frame(self) -> Mask:
        """``(h, w)`` what is not beyond the frame."""
        return inside_frame(self.frame_size, self.window)


def crop_window(image: NDArray, window: Window) -> NDArray:
    """What ``window`` sees of ``image`` ``(H, W)`` or ``(H, W, C)``, resampled to ``(h, w[, C])``.

    The part of the window beyond the frame repeats the frame's border. A mask becomes float32.
    """
    (height, width), (rows_seen, columns_seen) = window.sides, window.shape
    rows, above, below = _span(window.top, height, image.shape[0])
    columns, before, after = _span(window.left, width, image.shape[1])
    region = image[rows, columns]
    if region.dtype == np.bool_:
        region = region.astype(np.float32)
    if above or below or before or after:
        region = cv2.copyMakeBorder(region, above, below, before, after, cv2.BORDER_REPLICATE)
    smaller = rows_seen < height or columns_seen < width
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return cv2.resize(region, (columns_seen, rows_seen), interpolation=method)


def _span(first: int, count: int, size: int) -> tuple[slice, int, int]:
    """What of ``count`` places from ``first`` on lies in ``range(size)``, one at least; how many before and after."""
    begin, end = min(max(first, 0), size - 1), max(min(first + count, size), 1)
    end = max(end, begin + 1)
    before = min(max(-first, 0), count - 1)
    return slice(begin, end), before, count - (end - begin) - before


def inside_frame(shape: tuple[int, ...], window: Window) -> Mask:
    """``(h, w)``: which pixels of ``window`` lie inside a frame of ``shape`` ``(H, W, ...)``."""
    across, down = window.scales
    rows = window.top + (np.arange(window.shape[0]) + 0.5) / down
    columns = window.left + (np.arange(window.shape[1]) + 0.5) / across
    return ((rows > 0) & (rows < shape[0]))[:, None] & ((columns > 0) & (columns < shape[1]))
