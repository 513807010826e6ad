"""What the user says the object is in the first frame: a box or a mask, checked against that frame."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box, Frame, Prompt, SkippedFrame
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.mask_files import ImageMasks, UnreadableMaskError

_log = logging.getLogger(__name__)


def parse_box(text: str) -> Box:
    """Read ``X,Y,WIDTH,HEIGHT`` in pixels.

    Raises:
        InputError: Other than four numbers, or no positive size.
    """
    try:
        x, y, width, height = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(
            f"The box '{text}' is not four numbers; write it as X,Y,WIDTH,HEIGHT in pixels."
        ) from error
    return _checked((x, y, width, height))


def make_prompt(frame: Frame, box: Box | None = None, mask: NDArray[np.bool_] | Path | None = None) -> Prompt:
    """Make the prompt for ``frame``.

    Args:
        frame: The first frame.
        box: ``(x, y, width, height)`` in pixels. The part outside the frame is cut off, with a
            warning in the log.
        mask: ``(H, W)``, or an image file of one; what is not zero (in a file: above half) is the object.

    Raises:
        InputError: Neither or both are given, the box has no size or lies outside the frame, or the mask
            cannot be read, is empty, covers everything or is not of the frame's size.
    """
    if (box is None) == (mask is None):
        raise InputError("Say what the object is by either a box or a mask of the first frame.")
    if box is not None:
        try:
            x, y, width, height = (float(value) for value in box)
        except (TypeError, ValueError) as error:
            raise InputError(f"The box {box!r} is not four numbers x, y, width, height.") from error
        return Prompt(_inside(_checked((x, y, width, height)), frame))
    label = f"The mask {mask}" if isinstance(mask, Path) else "The mask"
    binary = _read(mask) if isinstance(mask, Path) else np.asarray(mask) != 0
    height, width = frame.size
    if binary.shape != frame.size:
        size = " x ".join(str(side) for side in binary.shape[::-1])
        raise InputError(
            f"{label} is {size} pixels but {_name(frame)} is {width} x {height}; they must be alike."
        )
    if binary.all():
        raise InputError(f"{label} covers the whole of {_name(frame)}; mark the object only.")
    around = box_of(binary)
    if around is None:
        raise InputError(f"{label} is empty; mark the object in it.")
    return Prompt(around, binary)


def make_prompts(
    frame: Frame,
    boxes: Sequence[Box] = (),
    masks: Sequence[NDArray[np.bool_] | Path] = (),
    tracker: str = "",
) -> list[Prompt]:
    """The prompts of several objects, first those of the boxes; see `make_prompt`.

    Args:
        frame: The first frame.
        boxes: Each ``(x, y, width, height)`` in pixels.
        masks: Each ``(H, W)``, or an image file of one.
        tracker: Name of the mask tracker.

    Raises:
        InputError: If there is no object, one cannot be used, or the tracker knows the masks of one object only.
    """
    prompts = [make_prompt(frame, box) for box in boxes] + [make_prompt(frame, mask=mask) for mask in masks]
    if not prompts:
        raise InputError("Say what the objects are by boxes or masks of the first frame.")
    if len(prompts) > 1 and tracker == "precomputed":
        raise InputError("Precomputed masks are of one object; track several in runs of their own.")
    return prompts


def damaged_start(frame: SkippedFrame) -> InputError:
    """The first frame cannot be read, and what the object is was said of that frame."""
    return InputError(
        f"The first frame, in which the object is given, cannot be read ({frame.reason.rstrip('.')}); begin with "
        "another one, or give --skip-damaged (skip_damaged) where the object has not moved until the next."
    )


def _checked(box: Box) -> Box:
    if not all(math.isfinite(value) for value in box):
        raise InputError(f"The box {_shown(box)} has a value that is no finite number.")
    if box[2] <= 0 or box[3] <= 0:
        raise InputError(f"The box {_shown(box)} has no size; its width and height must be positive.")
    return box


def _inside(box: Box, frame: Frame) -> Box:
    inside = clip_box(box, frame.size)
    if inside is None:
        height, width = frame.size
        raise InputError(
            f"The box {_shown(box)} lies outside {_name(frame)}, which is {width} x {height} pixels; "
            "give the object's box as X,Y,WIDTH,HEIGHT."
        )
    if inside != box:
        _log.warning(
            "The box %s reaches beyond the frame; its part inside is %s.", _shown(box), _shown(inside)
        )
    return inside


def _read(file: Path) -> NDArray[np.bool_]:
    if not file.is_file():
        raise InputError(f"The mask {file} does not exist.")
    try:
        mask = ImageMasks(file, [file]).read(0)
    except (InputError, UnreadableMaskError) as error:
        raise InputError(f"The mask {file} cannot be read as an image.") from error
    assert mask is not None  # there is one file
    return mask


def _shown(box: Box) -> str:
    return ",".join(f"{value:g}" for value in box)


def _name(frame: Frame) -> str:
    return frame.name or f"frame {frame.index}"
