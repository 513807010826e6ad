"""Corrections: prompts in later frames, from which the mask tracker restarts."""

from __future__ import annotations

import logging
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.explain import a_kind, format_value
from tracking3d.errors import InputError, argument
from tracking3d.frames import Box, Frame, Prompt, SkippedFrame, pixels
from tracking3d.trackers.prompts.boxes import BoxFormat, check_box_fits, parse_box
from tracking3d.trackers.prompts.points import (
    check_points_inside,
    looks_like_points,
    parse_points,
    validate_points,
)
from tracking3d.trackers.prompts.prompt import make_prompt, read_mask_file, validate_box, validate_mask

CORRECT = argument("corrections=", "--correct ")
"""Their name in messages, before their values."""
_FORM = (
    "FRAME:X,Y,W,H, FRAME:MASK.png or 'FRAME:X,Y+ X,Y-'; with several objects FRAME@OBJECT, counted from 0"
)
_LONGEST_VIDEO = 10**9
"""Frames; an index beyond is that of a selection without an end."""
_log = logging.getLogger(__name__)
_HEAD = re.compile(r"(\d{1,12})(?:@(\d{1,6}))?:(.+)", re.DOTALL)


@dataclass(frozen=True, eq=False)
class Correction:
    """A prompt in one later frame; exactly one of box, mask and points is given.

    Attributes:
        frame: Index of the frame.
        box: ``(x, y, width, height)`` in pixels.
        mask: ``(H, W)``, or its image file.
        points: ``(N, 3)``: x, y in pixels, and 1 on the object or 0 on the background.
        object: Index of the object, counted from 0; needed if there are several.
        box_format: How the user wrote the box; messages write it in the same way.
    """

    frame: int
    box: Box | None = None
    mask: NDArray[np.bool_] | Path | None = None
    points: Any = None
    object: int | None = None
    box_format: BoxFormat = "xywh"

    @property
    def name(self) -> str:
        """Its name in messages, before its value."""
        return f"{CORRECT}{self.frame}:"

    def prompt(self, frame: Frame) -> Prompt:
        """The prompt for its frame.

        Raises:
            InputError: It cannot be used there.
        """
        return make_prompt(
            frame,
            self.box,
            self.mask,
            points=self.points,
            box_name=self.name,
            mask_name=self.name,
            points_name=self.name,
            box_format=self.box_format,
        )

    def check_fits(self, size: tuple[int, int]) -> None:
        """Make sure that it fits a frame of ``size`` ``(height, width)``.

        Raises:
            InputError: It does not.
        """
        label = f"frame {self.frame}"
        if self.box is not None:
            check_box_fits(self.box, size, label, self.name, self.box_format)
        if isinstance(self.mask, np.ndarray) and self.mask.shape != size:
            raise InputError(
                f"{self.name} the mask is {pixels(self.mask.shape)} pixels, but {label} is {pixels(size)}; the sizes "
                "must be equal."
            )
        if self.points is not None:
            check_points_inside(self.points, size, label, self.name)


def prompts_in(frame: Frame, corrections: Mapping[int, Correction]) -> list[Prompt]:
    """The prompts that `tracking3d.Session.step` takes with a frame: its correction, if there is one."""
    correction = corrections.get(frame.index)
    return [] if correction is None else [correction.prompt(frame)]


def parse_correction(text: str, box_format: BoxFormat = "xywh") -> Correction:
    """Read ``FRAME:X,Y,W,H``, ``FRAME:MASK.png`` or ``FRAME:X,Y+ X,Y-``, with or without ``@OBJECT`` after FRAME.

    Args:
        text: The correction.
        box_format: How a box in it is written.

    Raises:
        InputError: The text is none of them.
    """
    head = _HEAD.fullmatch(text.strip())
    if head is None:
        raise InputError(f"{CORRECT}'{text}' is not of the form {_FORM}.")
    frame, number, what = int(head[1]), None if head[2] is None else int(head[2]), head[3].strip()
    name = f"{CORRECT}{frame}:"
    if looks_like_points(what):
        return Correction(frame, points=parse_points(what, name), object=number)
    if re.fullmatch(r"[-+.\deE,\s]+", what):
        box = parse_box(what, name, box_format)
        return Correction(frame, box=box, object=number, box_format=box_format)
    return Correction(frame, mask=Path(what), object=number)


def validate_corrections(
    corrections: Any, objects: int = 1, names: Sequence[str] = ()
) -> list[dict[int, Correction]]:
    """Check corrections, and sort them by object and frame; mask files are read.

    Args:
        corrections: Any number of them.
        objects: Number of objects.
        names: What the objects are called, if they have names.

    Raises:
        InputError: One is not a correction, two are for the same frame, or one is for an object that does not exist or
            does not say which of several objects it is for.
    """
    if not isinstance(corrections, Iterable) or isinstance(corrections, str | bytes | Mapping):
        raise InputError(
            f"{CORRECT}{format_value(corrections)} is {a_kind(corrections)}; give a list of Correction."
        )
    by_object: list[dict[int, Correction]] = [{} for _ in range(objects)]
    for one in corrections:
        correction = _validate_correction(one)
        number = correction.object
        if number is None and objects > 1:
            choice = ", ".join(
                argument(f"object={place}", f"{correction.frame}@{place}")
                + (f" ({names[place]})" if names else "")
                for place in range(objects)
            )
            raise InputError(
                f"{correction.name} does not say which of the {objects} objects it corrects; give one of {choice}."
            )
        number = number or 0
        if number >= objects:
            count = "is 1 object" if objects == 1 else f"are {objects} objects"
            raise InputError(f"{correction.name} is for object {number}, but there {count}, counted from 0.")
        correction = replace(correction, object=number)
        theirs = by_object[number]
        if correction.frame in theirs:
            raise InputError(
                f"{correction.name} frame {correction.frame} is corrected twice; give one correction per frame."
            )
        theirs[correction.frame] = correction
    return by_object


def check_corrections_fit(
    corrections: Iterable[Correction], first: Frame, tracker: str, indices: Collection[int] | None = None
) -> None:
    """Check corrections against the first frame, so that a bad one does not stop a long run later.

    Args:
        corrections: Those of one object.
        first: The frame of the prompt.
        tracker: Name of the mask tracker.
        indices: Indices of the tracked frames, if they are known.

    Raises:
        InputError: One cannot be used.
    """
    for one in corrections:
        if tracker == "precomputed":
            raise InputError(
                f"{one.name} the tracker 'precomputed' cannot be corrected; replace the mask file of that frame."
            )
        if one.frame == first.index:
            raise InputError(
                f"{one.name} frame {one.frame} is the frame of the prompt; change the prompt instead."
            )
        if indices is not None and one.frame not in indices:
            raise missing_frame_error(one, indices)
        one.check_fits(first.size)


def missing_frame_error(correction: Correction, indices: Collection[int]) -> InputError:
    """The error for a correction of a frame that is not among the tracked ones.

    Args:
        correction: The correction.
        indices: Indices of the tracked frames.
    """
    label = f"{correction.name} frame {correction.frame} is not among the tracked frames"
    if not indices or max(indices) > _LONGEST_VIDEO:
        return InputError(f"{label}; choose one that is.")
    count = f"{len(indices)} frame{'s' * (len(indices) != 1)}"
    return InputError(f"{label}: these are {count}, from {min(indices)} to {max(indices)}.")


class UnmetCorrections:
    """Corrections of frames that have not come yet, of a source that does not know its length before its end.

    Args:
        frames: Indices of the corrected frames.
    """

    def __init__(self, frames: Iterable[int]) -> None:
        self._unmet, self._count, self._last = set(frames), 0, -1

    def see(self, frame: Frame | SkippedFrame) -> None:
        """Take note of a frame; one that was skipped could not be corrected."""
        if isinstance(frame, Frame):
            self._unmet.discard(frame.index)
            self._count, self._last = self._count + 1, max(self._last, frame.index)

    def warn(self) -> None:
        """After the last frame: warn of corrections of frames that could not be read."""
        for index in sorted(self._unmet):
            _log.warning(
                "Frame %d, which was to be corrected, could not be read: there are %d frames, the last of them %d. "
                "All estimates were made without this correction.",
                index,
                self._count,
                self._last,
            )
        self._unmet = set()


def _validate_correction(correction: Any) -> Correction:
    if not isinstance(correction, Correction):
        raise InputError(
            f"{CORRECT}{format_value(correction)} is {a_kind(correction)}; give a list of Correction."
        )
    for value in (correction.frame, *(() if correction.object is None else (correction.object,))):
        if not isinstance(value, int) or isinstance(value, bool) or value < 0:
            raise InputError(
                f"{CORRECT}{format_value(value)} is not an index; frames and objects are counted from 0."
            )
    given = (correction.box, correction.mask, correction.points)
    if sum(one is not None for one in given) != 1:
        raise InputError(f"{correction.name} give either a box, a mask or points.")
    if correction.box is not None:
        return replace(correction, box=validate_box(correction.box, correction.name))
    if correction.points is not None:
        return replace(correction, points=validate_points(correction.points, correction.name))
    if isinstance(correction.mask, Path):
        mask = read_mask_file(correction.mask, f"{correction.name}{correction.mask}")
        return replace(correction, mask=validate_mask(mask, correction.name))
    return replace(correction, mask=validate_mask(correction.mask, correction.name))
