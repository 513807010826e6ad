"""The prompt, which says what the objects are in a frame: a box, a mask or points each, checked against that frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.explain import a_kind, format_value
from tracking3d.errors import InputError, argument
from tracking3d.frames import Box, Frame, Prompt, SkippedFrame
from tracking3d.trackers.prompts.boxes import BOX, BoxFormat, fit_box, format_box, parse_box, validate_box
from tracking3d.trackers.prompts.points import POINTS, points_prompt, validate_points

__all__ = ["PromptSet", "make_prompt", "parse_box", "validate_box", "validate_mask"]

MASK = argument("mask=", "--mask ")
"""Name of a mask in messages, before its value."""

_OPTIONS = {"boxes": "--box ", "masks": "--mask ", "points": "--points "}
_SKIP = argument("skip_damaged=True", "--skip-damaged")
_EITHER = "Give the object with one of a box, a mask or points in the first frame: {}, {} or {}.".format(
    argument("box=", "--box"), argument("mask=", "--mask"), argument("points=", "--points")
)
_NO_OBJECTS = "Give the objects with boxes, masks or points in the first frame: {}, {} or {}.".format(
    argument("boxes=", "--box"), argument("masks=", "--mask"), argument("points=", "--points")
)


@dataclass(frozen=True, eq=False)
class PromptSet:
    """The prompts of all objects in one frame, before that frame is read.

    There is one box, one mask or one list of points for each object. Objects are counted from 0: first those of the
    boxes, then those of the masks, then those of the points.

    Attributes:
        boxes: Each ``(x, y, width, height)`` in pixels.
        masks: Each ``(H, W)``, or the image file of one.
        points: Each ``(N, 3)``: x, y in pixels, and 1 on the object or 0 on the background.
        start_frame: Index of the prompt frame; None for the first frame of the video.
        as_lists: Whether the user gave lists of boxes, masks and points, as of several objects. Messages then say
            which item is wrong.
        box_format: How the user wrote the boxes; messages write them in the same way.
    """

    boxes: Sequence[Box] = ()
    masks: Sequence[NDArray[np.bool_] | Path] = ()
    points: Sequence[Any] = ()
    start_frame: int | None = None
    as_lists: bool = False
    box_format: BoxFormat = "xywh"

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
            InputError: There is no prompt but one is needed, there are several for one object, or one cannot be used.
        """
        if self.as_lists:
            for name, given in (("boxes", self.boxes), ("masks", self.masks), ("points", self.points)):
                if not isinstance(given, Sequence | np.ndarray) or isinstance(given, str | bytes):
                    raise InputError(
                        f"{name}={format_value(given)} is {a_kind(given)}; give a list with one item per object."
                    )
            if not len(self):
                raise InputError(_NO_OBJECTS)
        elif len(self) > 1 or (needed and not len(self)):
            raise InputError(_EITHER)
        for number, box in enumerate(self.boxes):
            validate_box(box, self._name(BOX, "boxes", number))
        for number, mask in enumerate(self.masks):
            if not isinstance(mask, Path):
                validate_mask(mask, self._name(MASK, "masks", number))
        for number, each in enumerate(self.points):
            validate_points(each, self._name(POINTS, "points", number))

    def make(self, frame: Frame, tracker: str) -> list[Prompt | None]:
        """Make the prompt of every object; that of the only one is None if the set is empty.

        Args:
            frame: The prompt frame.
            tracker: Name of the mask tracker.

        Raises:
            InputError: A prompt cannot be used in this frame, or the tracker reads the masks of one object only.
        """
        prompts: list[Prompt | None] = [
            make_prompt(frame, box, box_name=self._name(BOX, "boxes", number), box_format=self.box_format)
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
            raise InputError(
                "The tracker 'precomputed' reads the masks of one object; track each object in a run of its own."
            )
        return prompts or [None]

    def _name(self, one: str, several: str, number: int) -> str:
        """Name of a prompt in messages, before its value."""
        if not self.as_lists:
            return one
        return argument(f"{several}[{number}]=", _OPTIONS[several])


def make_prompt(
    frame: Frame,
    box: Box | None = None,
    mask: NDArray[np.bool_] | Path | None = None,
    *,
    points: Any = None,
    box_name: str = BOX,
    mask_name: str = MASK,
    points_name: str = POINTS,
    box_format: BoxFormat = "xywh",
) -> Prompt:
    """Make the prompt for ``frame``.

    Args:
        frame: The frame that is prompted.
        box: ``(x, y, width, height)`` in pixels. If it reaches a few pixels beyond the frame, the part outside is cut
            off, with a warning in the log.
        mask: ``(H, W)``, or its image file; the object is where it is not zero (in a file: above half).
        points: ``(N, 3)``: x, y in pixels, and 1 on the object or 0 on the background; see `prompts.points`.
        box_name: Name of the box in messages, see `tracking3d.errors.argument`.
        mask_name: Name of the mask.
        points_name: Name of the points.
        box_format: How the user wrote the box; messages write it in the same way.

    Raises:
        InputError: None or more than one are given, the box has no size, lies outside the frame or reaches far beyond
            it, the mask cannot be read, is empty, covers everything or is not of the frame's size, or the points lie
            outside, contradict each other, or none is on the object.
    """
    PromptSet.of_one(box, mask, points).check()
    if points is not None:
        return points_prompt(frame, points, points_name)
    if box is not None:
        return Prompt(fit_box(validate_box(box, box_name), frame, box_name, box_format))
    from tracking3d.trackers.crops import box_of

    label = f"{mask_name}{mask if isinstance(mask, Path) else ''}"
    binary = read_mask_file(mask, label) if isinstance(mask, Path) else validate_mask(mask, mask_name)
    height, width = frame.size
    if binary.shape != frame.size:
        size = " x ".join(str(side) for side in binary.shape[::-1])
        raise InputError(
            f"{label} is {size} pixels, but {frame.label} is {width} x {height}; the sizes must be equal."
        )
    if binary.all():
        raise InputError(f"{label} covers all of {frame.label}; mark only the object.")
    around = box_of(binary)
    if around is None:
        raise InputError(f"{label} is empty; mark the object in it.")
    return Prompt(around, binary)


def damaged_start_error(frame: SkippedFrame) -> InputError:
    """The error if the first frame, which the prompt is for, cannot be decoded."""
    return InputError(
        f"The first frame, which the prompt is for, cannot be decoded ({frame.reason.rstrip('.')}); start at another "
        f"frame, or give {_SKIP} if the object does not move before the next one."
    )


def check_prompt_fits(prompt: Prompt, frame: Frame) -> None:
    """Make sure that a prompt fits the size of the frame.

    Raises:
        InputError: Its mask has another size, or its box lies outside.
    """
    from tracking3d.trackers.crops import clip_box

    height, width = frame.size
    if prompt.mask is not None and np.shape(prompt.mask) != frame.size:
        raise InputError(
            f"prompt.mask= has shape {np.shape(prompt.mask)}, but {frame.label} has ({height}, {width}); make the "
            "prompt from the first frame."
        )
    if clip_box(prompt.box, frame.size) is None:
        raise InputError(
            f"prompt.box={format_box(prompt.box)} lies outside {frame.label}, which is {width} x {height} pixels."
        )


def validate_mask(mask: Any, name: str = MASK) -> NDArray[np.bool_]:
    """Check a mask, and return it as ``(H, W)`` bool: true where the array is not zero.

    Args:
        mask: ``(H, W)`` booleans or numbers.
        name: Its name in messages.

    Raises:
        InputError: It is not such an array, or it is empty.
    """
    wanted = "give an (H, W) array of booleans, or its image file as a pathlib.Path"
    if isinstance(mask, str | bytes):
        raise InputError(f"{name}{format_value(mask)} is {a_kind(mask)}; {wanted}.")
    try:
        values = np.asarray(mask)
    except Exception as error:  # converting a foreign object can raise anything
        raise InputError(f"{name.rstrip()} is {a_kind(mask)} that NumPy cannot convert; {wanted}.") from error
    if values.dtype.kind not in "biuf" or values.ndim != 2 or not values.size:
        raise InputError(
            f"{name.rstrip()} is {a_kind(mask)} of shape {values.shape} and type {values.dtype}; {wanted}."
        )
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise InputError(f"{name.rstrip()} has values that are not finite; {wanted}.")
    if not values.any():
        raise InputError(f"{name.rstrip()} is empty; mark the object in it.")
    return values != 0


def read_mask_file(file: Path, label: str) -> NDArray[np.bool_]:
    """Read the mask ``(H, W)`` in an image file, true where brighter than half; messages call it ``label``.

    ``FILE@N`` is object N of an indexed image, such as the annotations of DAVIS.

    Raises:
        InputError: It does not exist, or cannot be read.
    """
    from tracking3d.trackers.mask_images import ImageMasks, UnreadableMaskError, split_object

    try:
        there = file.is_file()
        if not there:
            file, number = split_object(file)
            there = number is not None and file.is_file()
        else:
            number = None
    except (OSError, ValueError):  # a loop of links, or an impossible file name
        there = False
    if not there:
        raise InputError(f"{label} does not exist.")
    try:
        mask = ImageMasks(file, [file], number).read(0)
    except (InputError, UnreadableMaskError) as error:
        raise InputError(f"{label} cannot be read as an image.") from error
    assert mask is not None  # there is one file
    return mask
