"""What the user says the objects are in a frame: a box, a mask or points each, checked against that frame."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.explain import a_kind, shown
from tracking3d.errors import InputError, argument
from tracking3d.frames import Box, Frame, Prompt, SkippedFrame
from tracking3d.point_prompts import POINTS, checked_points, points_prompt
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.mask_images import ImageMasks, UnreadableMaskError, split_object

_log = logging.getLogger(__name__)


BOX = argument("box=", "--box ")
MASK = argument("mask=", "--mask ")
"""What sentences call the two, before their values."""

_OPTIONS = {"boxes": "--box ", "masks": "--mask ", "points": "--points "}
_SKIP = argument("skip_damaged=True", "--skip-damaged")
_EITHER = "Say what the object is by either a box or a mask of the first frame, or points in it: {}, {} or {}.".format(
    argument("box=", "--box"), argument("mask=", "--mask"), argument("points=", "--points")
)
_NO_OBJECTS = (
    "Say what the objects are by boxes or masks of the first frame, or points in it: {}, {} or {}.".format(
        argument("boxes=", "--box"), argument("masks=", "--mask"), argument("points=", "--points")
    )
)


@dataclass(frozen=True, eq=False)
class PromptSet:
    """What the user says the objects of a video are in one frame, before that frame is read.

    There is one box, one mask or one list of points for each object. Objects are counted from 0: first those of the
    boxes, then those of the masks, then those of the points.

    Attributes:
        boxes: Each ``(x, y, width, height)`` in pixels.
        masks: Each ``(H, W)``, or the image file of one.
        points: Each ``(N, 3)``: x, y in pixels, and 1 on the object or 0 on the background.
        start_frame: Index of the prompt frame; None for the first frame of the video.
        as_lists: Whether the user gave lists of boxes, masks and points, as of several objects. Messages then say
            which item is wrong.
    """

    boxes: Sequence[Box] = ()
    masks: Sequence[NDArray[np.bool_] | Path] = ()
    points: Sequence[Any] = ()
    start_frame: int | None = None
    as_lists: bool = False

    @classmethod
    def of_one(
        cls,
        box: Box | None = None,
        mask: NDArray[np.bool_] | Path | None = None,
        points: Any = None,
        start_frame: int | None = None,
    ) -> PromptSet:
        """The prompt of one object; an empty set if all three are None."""
        boxes = () if box is None else (box,)
        masks = () if mask is None else (mask,)
        return cls(boxes, masks, () if points is None else (points,), start_frame)

    def __len__(self) -> int:
        """The number of objects; 0 if the mask tracker or an earlier run knows the only one."""
        return len(self.boxes) + len(self.masks) + len(self.points)

    def check(self, needed: bool = True) -> None:
        """Check everything that can be checked before the prompt frame is read.

        Args:
            needed: Whether a prompt is needed; lists must always have one.

        Raises:
            InputError: If there is no prompt though one is needed, there are several for one object, or one cannot be
                used.
        """
        if self.as_lists:
            for name, given in (("boxes", self.boxes), ("masks", self.masks), ("points", self.points)):
                if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str | bytes):
                    raise InputError(
                        f"{name}={shown(given)} is {a_kind(given)}; give a list with one for each object."
                    )
            if not len(self):
                raise InputError(_NO_OBJECTS)
        elif len(self) > 1 or (needed and not len(self)):
            raise InputError(_EITHER)
        for number, box in enumerate(self.boxes):
            checked_box(box, self._name(BOX, "boxes", number))
        for number, mask in enumerate(self.masks):
            if not isinstance(mask, Path):
                checked_mask(mask, self._name(MASK, "masks", number))
        for number, each in enumerate(self.points):
            checked_points(each, self._name(POINTS, "points", number))

    def make(self, frame: Frame, tracker: str) -> list[Prompt | None]:
        """Make the prompt of every object; that of the only one is None if the set is empty.

        Args:
            frame: The prompt frame.
            tracker: Name of the mask tracker.

        Raises:
            InputError: If a prompt cannot be used in this frame, or the tracker knows the masks of one object only.
        """
        prompts: list[Prompt | None] = [
            make_prompt(frame, box, box_name=self._name(BOX, "boxes", number))
            for number, box in enumerate(self.boxes)
        ]
        prompts += [
            make_prompt(frame, mask=mask, mask_name=self._name(MASK, "masks", number))
            for number, mask in enumerate(self.masks)
        ]
        prompts += [
            make_prompt(frame, points=each, points_name=self._name(POINTS, "points", number))
            for number, each in enumerate(self.points)
        ]
        if len(prompts) > 1 and tracker == "precomputed":
            raise InputError("Precomputed masks are of one object; track several in runs of their own.")
        return prompts or [None]

    def _name(self, one: str, several: str, number: int) -> str:
        """What messages call a prompt, before its value."""
        if not self.as_lists:
            return one
        return argument(f"{several}[{number}]=", _OPTIONS[several])


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
    return checked_box((x, y, width, height), name)


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
        points: ``(N, 3)``: x, y in pixels, and 1 on the object or 0 beside it; see `tracking3d.point_prompts`.
        box_name: What sentences call the box, see `tracking3d.errors.argument`.
        mask_name: What they call the mask.
        points_name: What they call the points.

    Raises:
        InputError: None or more than one are given, the box has no size or lies outside the frame, the mask
            cannot be read, is empty, covers everything or is not of the frame's size, or the points lie outside,
            contradict each other, or none is on the object.
    """
    PromptSet.of_one(box, mask, points).check()
    if points is not None:
        return points_prompt(frame, points, points_name)
    if box is not None:
        return Prompt(_inside(checked_box(box, box_name), frame, box_name))
    label = f"{mask_name}{mask if isinstance(mask, Path) else ''}"
    binary = read_mask_file(mask, label) if isinstance(mask, Path) else checked_mask(mask, mask_name)
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


def damaged_start(frame: SkippedFrame) -> InputError:
    """The first frame cannot be read, and what the object is was said of that frame."""
    return InputError(
        f"The first frame, in which the object is given, cannot be read ({frame.reason.rstrip('.')}); begin with "
        f"another one, or give {_SKIP} where the object has not moved until the next."
    )


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
            f"prompt.box={_shown(prompt.box)} lies outside {frame.label}, which is {width} x {height} pixels."
        )


def checked_box(box: Any, name: str = BOX) -> Box:
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
        raise InputError(f"{name}{shown(box)} is not four numbers x, y, width, height in pixels.") from error
    if not all(math.isfinite(value) for value in (x, y, width, height)):
        raise InputError(f"{name}{_shown((x, y, width, height))} has a value that is no finite number.")
    if width <= 0 or height <= 0:
        raise InputError(
            f"{name}{_shown((x, y, width, height))} has no size; its width and height must be positive."
        )
    return x, y, width, height


def checked_mask(mask: Any, name: str = MASK) -> NDArray[np.bool_]:
    """``(H, W)`` bool of what is not zero in an array, and is neither all nor nothing of it.

    Args:
        mask: ``(H, W)`` booleans or numbers.
        name: What sentences call it.

    Raises:
        InputError: If it is no such array.
    """
    wanted = "give an (H, W) array of booleans, or the image file of one as a pathlib.Path"
    if isinstance(mask, str | bytes):
        raise InputError(f"{name}{shown(mask)} is {a_kind(mask)}; {wanted}.")
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
            f"{name}{_shown(box)} lies outside {frame.label}, which is {width} x {height} pixels; "
            "give the object's box as left edge, upper edge, width and height."
        )
    if inside != box:
        _log.warning(
            "The box %s reaches beyond the frame; its part inside is %s.", _shown(box), _shown(inside)
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


def _shown(box: Box) -> str:
    return ",".join(f"{value:g}" for value in box)
