"""What the user says the object is in a frame: a box, a mask or points, checked against that frame."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.explain import a_kind, format_value
from tracking3d.errors import InputError, argument
from tracking3d.frames import Box, Frame, Prompt, SkippedFrame
from tracking3d.prompts.points import POINTS, points_prompt, validate_points
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.mask_images import ImageMasks, UnreadableMaskError, split_object

_log = logging.getLogger(__name__)


BOX = argument("box=", "--box ")
MASK = argument("mask=", "--mask ")
"""What sentences call the two, before their values."""

_SKIP = argument("skip_damaged=True", "--skip-damaged")
_EITHER = "Say what the object is by either a box or a mask of the first frame, or points in it: {}, {} or {}.".format(
    argument("box=", "--box"), argument("mask=", "--mask"), argument("points=", "--points")
)
_NO_OBJECTS = (
    "Say what the objects are by boxes or masks of the first frame, or points in it: {}, {} or {}.".format(
        argument("boxes=", "--box"), argument("masks=", "--mask"), argument("points=", "--points")
    )
)


def parse_box(text: str, name: str = BOX) -> Box:
    """Read ``X,Y,WIDTH,HEIGHT`` in pixels; ``name`` is what sentences call it.

    Raises:
        InputError: Other than four numbers, or no positive size.
    """
    try:
        x, y, width, height = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(
            f"{name}'{text}' is not four numbers; write it as X,Y,WIDTH,HEIGHT in pixels."
        ) from error
    return validate_box((x, y, width, height), name)


def check_prompt(box: Any, mask: Any, needed: bool = True, points: Any = None) -> None:
    """Make sure of a box, a mask or points as far as that can be done before the first frame is there.

    Args:
        box: ``(x, y, width, height)`` in pixels, or None.
        mask: ``(H, W)``, an image file of one, or None.
        needed: Whether one of them must be given.
        points: See `tracking3d.prompts.points.validate_points`, or None.

    Raises:
        InputError: None (if needed) or more than one are given, or what is given cannot be one.
    """
    given = sum(one is not None for one in (box, mask, points))
    if given > 1 or (needed and not given):
        raise InputError(_EITHER)
    if box is not None:
        validate_box(box)
    if points is not None:
        validate_points(points)
    if mask is not None and not isinstance(mask, Path):
        validate_mask(mask)


def make_prompt(
    frame: Frame,
    box: Box | None = None,
    mask: NDArray[np.bool_] | Path | None = None,
    *,
    points: Any = None,
    box_name: str = BOX,
    mask_name: str = MASK,
    points_name: str = POINTS,
) -> Prompt:
    """Make the prompt for ``frame``.

    Args:
        frame: The first frame, or the one of which something is told.
        box: ``(x, y, width, height)`` in pixels. The part outside the frame is cut off, with a
            warning in the log.
        mask: ``(H, W)``, or an image file of one; what is not zero (in a file: above half) is the object.
        points: ``(N, 3)``: x, y in pixels, and 1 on the object or 0 beside it; see `tracking3d.prompts.points`.
        box_name: What sentences call the box, see `tracking3d.errors.argument`.
        mask_name: What they call the mask.
        points_name: What they call the points.

    Raises:
        InputError: None or more than one are given, the box has no size or lies outside the frame, the mask
            cannot be read, is empty, covers everything or is not of the frame's size, or the points lie outside,
            contradict each other, or none is on the object.
    """
    check_prompt(box, mask, points=points)
    if points is not None:
        return points_prompt(frame, points, points_name)
    if box is not None:
        return Prompt(_inside(validate_box(box, box_name), frame, box_name))
    label = f"{mask_name}{mask if isinstance(mask, Path) else ''}"
    binary = read_mask_file(mask, label) if isinstance(mask, Path) else validate_mask(mask, mask_name)
    height, width = frame.size
    if binary.shape != frame.size:
        size = " x ".join(str(side) for side in binary.shape[::-1])
        raise InputError(
            f"{label} is {size} pixels but {frame.label} is {width} x {height}; they must be alike."
        )
    if binary.all():
        raise InputError(f"{label} covers the whole of {frame.label}; mark the object only.")
    around = box_of(binary)
    if around is None:
        raise InputError(f"{label} is empty; mark the object in it.")
    return Prompt(around, binary)


def make_prompts(
    frame: Frame,
    boxes: Sequence[Box] = (),
    masks: Sequence[NDArray[np.bool_] | Path] = (),
    tracker: str = "",
    points: Sequence[Any] = (),
) -> list[Prompt]:
    """The prompts of several objects, first those of the boxes, then those of the masks; see `make_prompt`.

    Args:
        frame: The first frame.
        boxes: Each ``(x, y, width, height)`` in pixels.
        masks: Each ``(H, W)``, or an image file of one.
        tracker: Name of the mask tracker.
        points: The points of each object.

    Raises:
        InputError: If there is no object, one cannot be used, or the tracker knows the masks of one object only.
    """
    prompts = [
        make_prompt(frame, box, box_name=argument(f"boxes[{number}]=", "--box "))
        for number, box in enumerate(boxes)
    ]
    prompts += [
        make_prompt(frame, mask=mask, mask_name=argument(f"masks[{number}]=", "--mask "))
        for number, mask in enumerate(masks)
    ]
    prompts += [
        make_prompt(frame, points=each, points_name=argument(f"points[{number}]=", "--points "))
        for number, each in enumerate(points)
    ]
    if not prompts:
        raise InputError(_NO_OBJECTS)
    if len(prompts) > 1 and tracker == "precomputed":
        raise InputError("Precomputed masks are of one object; track several in runs of their own.")
    return prompts


def damaged_start_error(frame: SkippedFrame) -> InputError:
    """The first frame cannot be read, and what the object is was said of that frame."""
    return InputError(
        f"The first frame, in which the object is given, cannot be read ({frame.reason.rstrip('.')}); begin with "
        f"another one, or give {_SKIP} where the object has not moved until the next."
    )


def check_prompts(boxes: Any, masks: Any, points: Any = ()) -> None:
    """Make sure of the prompts of several objects as far as that can be done before the first frame is there.

    Raises:
        InputError: If there is none, or one cannot be used.
    """
    for name, given in (("boxes", boxes), ("masks", masks), ("points", points)):
        if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str | bytes):
            raise InputError(
                f"{name}={format_value(given)} is {a_kind(given)}; give a list with one for each object."
            )
    if not len(boxes) and not len(masks) and not len(points):
        raise InputError(_NO_OBJECTS)
    for number, box in enumerate(boxes):
        validate_box(box, argument(f"boxes[{number}]=", "--box "))
    for number, mask in enumerate(masks):
        if not isinstance(mask, Path):
            validate_mask(mask, argument(f"masks[{number}]=", "--mask "))
    for number, each in enumerate(points):
        validate_points(each, argument(f"points[{number}]=", "--points "))


def check_prompt_fits(prompt: Prompt, frame: Frame) -> None:
    """Make sure that a prompt is one of a frame of this size.

    Raises:
        InputError: If its mask has another size, or its box lies outside.
    """
    height, width = frame.size
    if prompt.mask is not None and np.shape(prompt.mask) != frame.size:
        raise InputError(
            f"prompt.mask= has shape {np.shape(prompt.mask)} but {frame.label} ({height}, {width}); make the "
            "prompt of the first frame."
        )
    if clip_box(prompt.box, frame.size) is None:
        raise InputError(
            f"prompt.box={_format(prompt.box)} lies outside {frame.label}, which is {width} x {height} pixels."
        )


def validate_box(box: Any, name: str = BOX) -> Box:
    """Four finite numbers, the last two positive.

    Args:
        box: ``(x, y, width, height)`` in pixels, of any kind of sequence.
        name: What sentences call it.

    Raises:
        InputError: If it is anything else.
    """
    try:
        if isinstance(box, str | bytes | Mapping) or any(isinstance(value, str | bytes) for value in box):
            raise TypeError
        x, y, width, height = (float(value) for value in box)
    except Exception as error:  # iterating over what somebody gave can end in any way
        raise InputError(
            f"{name}{format_value(box)} is not four numbers x, y, width, height in pixels."
        ) from error
    if not all(math.isfinite(value) for value in (x, y, width, height)):
        raise InputError(f"{name}{_format((x, y, width, height))} has a value that is no finite number.")
    if width <= 0 or height <= 0:
        raise InputError(
            f"{name}{_format((x, y, width, height))} has no size; its width and height must be positive."
        )
    return x, y, width, height


def validate_mask(mask: Any, name: str = MASK) -> NDArray[np.bool_]:
    """``(H, W)`` bool of what is not zero in an array, and is neither all nor nothing of it.

    Args:
        mask: ``(H, W)`` booleans or numbers.
        name: What sentences call it.

    Raises:
        InputError: If it is no such array.
    """
    wanted = "give an (H, W) array of booleans, or the image file of one as a pathlib.Path"
    if isinstance(mask, str | bytes):
        raise InputError(f"{name}{format_value(mask)} is {a_kind(mask)}; {wanted}.")
    try:
        values = np.asarray(mask)
    except Exception as error:  # what a class makes of itself as an array can fail in any way
        raise InputError(f"{name.rstrip()} is {a_kind(mask)} that numpy cannot read; {wanted}.") from error
    if values.dtype.kind not in "biuf" or values.ndim != 2 or not values.size:
        raise InputError(
            f"{name.rstrip()} is {a_kind(mask)} of shape {values.shape} and type {values.dtype}; {wanted}."
        )
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError(f"{name.rstrip()} has values that are no finite numbers; {wanted}.")
    if not values.any():
        raise InputError(f"{name.rstrip()} is empty; mark the object in it.")
    return values != 0


def _inside(box: Box, frame: Frame, name: str) -> Box:
    inside = clip_box(box, frame.size)
    if inside is None:
        height, width = frame.size
        raise InputError(
            f"{name}{_format(box)} lies outside {frame.label}, which is {width} x {height} pixels; "
            "give the object's box as left edge, upper edge, width and height."
        )
    if inside != box:
        _log.warning(
            "The box %s reaches beyond the frame; its part inside is %s.", _format(box), _format(inside)
        )
    return inside


def read_mask_file(file: Path, label: str) -> NDArray[np.bool_]:
    """The mask ``(H, W)`` in an image file, which sentences call ``label``: what is brighter than half.

    ``FILE@N`` is object N of an indexed image, such as the annotations of DAVIS.

    Raises:
        InputError: If it does not exist, or cannot be read.
    """
    try:
        there = file.is_file()
        if not there:
            file, number = split_object(file)
            there = number is not None and file.is_file()
        else:
            number = None
    except (OSError, ValueError):  # a loop of links, a name that no file can have
        there = False
    if not there:
        raise InputError(f"{label} does not exist.")
    try:
        mask = ImageMasks(file, [file], number).read(0)
    except (InputError, UnreadableMaskError) as error:
        raise InputError(f"{label} cannot be read as an image.") from error
    assert mask is not None  # there is one file
    return mask


def _format(box: Box) -> str:
    return ",".join(f"{value:g}" for value in box)
