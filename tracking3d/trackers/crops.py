"""Masks of crops pasted into frames, and boxes."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box, Frame
from tracking3d.geometry.camera import Window


def paste_mask(mask: NDArray[np.bool_], window: Window, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """A full-frame mask ``(H, W)`` in [0, 1] from a window's ``(size, size)`` mask, smooth at its outline."""
    height, width = shape[:2]
    soft = cv2.GaussianBlur(mask.astype(np.float32), (3, 3), 0)
    region = cv2.resize(soft, (window.side, window.side), interpolation=cv2.INTER_LINEAR)
    full = np.zeros((height, width), np.float32)
    x0, y0 = max(window.left, 0), max(window.top, 0)
    x1, y1 = min(window.left + window.side, width), min(window.top + window.side, height)
    if x1 > x0 and y1 > y0:
        full[y0:y1, x0:x1] = region[y0 - window.top : y1 - window.top, x0 - window.left : x1 - window.left]
    return full


def box_of(mask: NDArray) -> Box | None:
    """The bounding box of ``mask > 0.5``, or None if it is empty."""
    x, y, width, height = cv2.boundingRect((mask > 0.5).astype(np.uint8))
    return (float(x), float(y), float(width), float(height)) if width and height else None


def clip_box(box: Box, shape: tuple[int, ...]) -> Box | None:
    """The part of ``box`` inside a frame of ``shape`` ``(H, W, ...)``; None if under a pixel is left."""
    x0, y0 = max(box[0], 0.0), max(box[1], 0.0)
    x1, y1 = min(box[0] + box[2], float(shape[1])), min(box[1] + box[3], float(shape[0]))
    return (x0, y0, x1 - x0, y1 - y0) if x1 - x0 >= 1 and y1 - y0 >= 1 else None


def check_box_in_frame(box: Box, frame: Frame) -> None:
    """Make sure that a first box shows something.

    Raises:
        InputError: Under a pixel of the box is inside the frame.
    """
    if clip_box(box, frame.image.shape) is None:
        raise InputError(
            f"The box {box} lies outside {frame.name or 'the first frame'}; give a box inside it."
        )


def outside(box: Box, shape: tuple[int, ...], slack: float = 0.0) -> NDArray[np.bool_]:
    """``(H, W)``: the pixels of a frame of ``shape`` that are not in ``box``, grown by a share of its sides."""
    x, y, width, height = box
    rows, columns = np.arange(shape[0])[:, None] + 0.5, np.arange(shape[1]) + 0.5
    beside_rows = (rows < y - slack * height) | (rows > y + (1 + slack) * height)
    return beside_rows | (columns < x - slack * width) | (columns > x + (1 + slack) * width)


def box_iou(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    width = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    height = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    common = max(width, 0.0) * max(height, 0.0)
    return common / max(a[2] * a[3] + b[2] * b[3] - common, 1e-9)
