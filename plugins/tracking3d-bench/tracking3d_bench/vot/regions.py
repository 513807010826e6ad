"""Regions as the VOT toolkit hands them to its trackers, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Frame, Prompt
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.prompts.prompt import make_prompt, validate_box
from tracking3d.trackers.vot_regions import Polygon, rasterise


class MaskRows(list[list[int]]):
    """A mask as a list of rows of 0 and 1, which is how the ``python`` protocol knows one.

    Toolkit 0.9.0 checks that it is given lists and then treats them as an array, so plain lists fail there.
    """

    @classmethod
    def of(cls, mask: NDArray[np.bool_]) -> MaskRows:
        """The rows of ``mask`` ``(H, W)``."""
        return cls(mask.astype(np.uint8).tolist())

    def astype(self, dtype: DTypeLike) -> NDArray:
        """The mask as an array ``(H, W)``, like ``numpy.ndarray.astype``."""
        return np.array(self, dtype=dtype)


def prompt_of(region: Any, frame: Frame, offset: tuple[int, int] = (0, 0)) -> Prompt:
    """The object in its first frame.

    Args:
        region: ``(x, y, width, height)``; the points ``(x, y)`` of a polygon; or a mask ``(h, w)``, an array or rows,
            which may be smaller than the frame.
        frame: The frame.
        offset: Column and row of a mask's first pixel in the frame.

    Raises:
        InputError: If it is none of these, or marks nothing in the frame.
    """
    if isinstance(region, tuple) and len(region) == 4 and np.ndim(region) == 1:
        # The rectangle of a toolkit may reach beyond the frame.
        return make_prompt(frame, box=clip_box(validate_box(region), frame.size) or region)
    try:
        if isinstance(region, list) and all(isinstance(point, tuple) for point in region):
            points = tuple((float(x), float(y)) for x, y in region)
            if len(points) < 3 or not np.isfinite(points).all():
                raise ValueError(f"a polygon of {len(points)} points")
            return make_prompt(frame, mask=rasterise(Polygon(points), frame.size))
        mask = np.asarray(region)
        if mask.ndim != 2 or mask.dtype.kind not in "biuf":
            raise ValueError(f"an array of shape {mask.shape} and type {mask.dtype}")
    except (TypeError, ValueError) as error:
        raise InputError(f"The first region is no rectangle, polygon or mask ({error}).") from error
    return make_prompt(frame, mask=place_mask(mask != 0, offset, frame.size))


def place_mask(mask: NDArray[np.bool_], offset: tuple[int, int], size: tuple[int, int]) -> NDArray[np.bool_]:
    """A mask ``(h, w)`` whose first pixel is at column and row ``offset``, in a frame of ``size`` (height, width)."""
    full = np.zeros(size, bool)
    left, top = offset
    part = mask[max(-top, 0) :, max(-left, 0) :]
    left, top = max(left, 0), max(top, 0)
    target = full[top : top + part.shape[0], left : left + part.shape[1]]
    target[:] = part[: target.shape[0], : target.shape[1]]
    return full


def rectangle_of(mask: NDArray[np.bool_]) -> tuple[float, float, float, float]:
    """The bounding box of ``mask`` ``(H, W)``; all 0 if it is empty."""
    return box_of(mask) or (0.0, 0.0, 0.0, 0.0)
