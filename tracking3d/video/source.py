"""The protocol of frame sources, and its guarantees: one frame size, at least one frame."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from tracking3d.errors import InputError, argument
from tracking3d.frames import Frame, SkippedFrame, pixels

Intrinsics = tuple[float, float, float, float]
"""``(fx, fy, cx, cy)`` in pixels of the full frame; pixel (0, 0) is the centre of the top-left pixel."""


@runtime_checkable
class FrameSource(Protocol):
    """Gives frames one at a time, in order; never holds more than one of them.

    Every `Frame` has the size of the first one. What cannot be used is given as a `SkippedFrame` in its
    place. Files can be iterated again from the start; cameras and one-shot iterables go on where they are.

    Attributes:
        name: What messages call the source: the path as given, or ``"camera 0"``.
        count: Number of selected frames if it is cheaply known (of videos, as the header has it), or None.
        fps: Selected frames per second (the source's rate over the step), or None if it has no rate.
        intrinsics: ``(fx, fy, cx, cy)`` in pixels if the source knows its lens, else None.
        intrinsics_origin: Where the intrinsics came from, in words; empty if there are none.
        repeatable: Whether iterating once more gives the same frames again.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def count(self) -> int | None: ...  # noqa: D102

    @property
    def fps(self) -> float | None: ...  # noqa: D102

    @property
    def intrinsics(self) -> Intrinsics | None: ...  # noqa: D102

    @property
    def intrinsics_origin(self) -> str: ...  # noqa: D102

    @property
    def repeatable(self) -> bool: ...  # noqa: D102

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Decode the selected frames.

        Raises:
            InputError: At the end, if not one frame could be used.
        """
        ...


def source_notes(source: FrameSource) -> tuple[str, ...]:
    """What a source did to its pictures, in clauses; sources that do nothing need not say so."""
    return tuple(getattr(source, "notes", ()))


def is_live(source: FrameSource) -> bool:
    """Whether a source's frames do not wait until they are taken; a source that is live says so by ``live``."""
    return bool(getattr(source, "live", False))


def known_indices(source: FrameSource) -> Collection[int] | None:
    """Indices of the frames that a source will give; None if it does not know them before its end.

    A source knows them by its attributes ``selection`` and ``count``, unless it has an attribute ``indices``.
    """
    if hasattr(source, "indices"):
        indices: Collection[int] | None = source.indices
        return indices
    selection: range | None = getattr(source, "selection", None)
    if selection is None or (source.count is None and selection.stop == EVERY_FRAME.stop):
        return None
    return selection if source.count is None else selection[: source.count]


def check_frames(
    frames: Iterable[Frame | SkippedFrame], name: str, distinct: Collection[int] | None = None
) -> Iterator[Frame | SkippedFrame]:
    """Pass ``frames`` on; skip those of another size than the first, and insist on at least one.

    Args:
        frames: The frames of one source, with those it could not decode.
        name: The source's name, for messages.
        distinct: If given, pictures that repeat the one before to the bit are skipped, but for these indices.

    Raises:
        InputError: After the last frame, if there was none to use.
    """
    first: tuple[str, tuple[int, int]] | None = None
    reason: str | None = None
    last: Frame | None = None
    for frame in frames:
        if isinstance(frame, SkippedFrame):
            reason = reason or frame.reason
            yield frame
        elif first is None or frame.size == first[1]:
            first = first or (frame.name, frame.size)
            seen = last if distinct is not None and frame.index not in distinct else None
            if seen and (frame.image is seen.image or np.array_equal(frame.image, seen.image)):
                why = f"the picture of {seen.label} again"
                yield SkippedFrame(frame.index, why, seen.index, frame.time, frame.name)
                continue
            last = None if distinct is None else frame
            yield frame
        else:
            yield SkippedFrame(
                frame.index,
                f"{frame.name} has {pixels(frame.size)} pixels but {first[0]}, the first, "
                f"has {pixels(first[1])}; all frames must have one size",
            )
    if first is None:
        raise InputError(
            f"{name} has no frame in the selected range; choose other frames."
            if reason is None
            else f"{name} has no frame that can be decoded ({reason})."
        )


_FRAMES = argument("frames=", "--frames ")

EVERY_FRAME = range(0, sys.maxsize, 1)
"""The default selection."""


def parse_selection(text: str | None) -> range:
    """Turn ``START:STOP:STEP`` into the range of wanted frame indices.

    Python's slice rules without negative numbers: each part may be left out, STOP itself is not included, and
    STEP with its colon may be missing. None means every frame.

    Returns:
        The wanted indices, ending one past the last of them; without STOP, far beyond any video.

    Raises:
        InputError: If ``text`` is not of that form or selects nothing.
    """
    if text is None:
        return EVERY_FRAME
    if not isinstance(text, str):
        raise InputError(
            f"frames={text!r:.60} is not a text START:STOP:STEP, for example '0:100' or '10::2'."
        )
    parts = [part.strip() for part in text.split(":")]
    if len(parts) not in (2, 3) or not all(re.fullmatch("[0-9]{0,18}", part) for part in parts):
        raise InputError(
            f"{_FRAMES}{text!r} is not START:STOP:STEP with whole numbers from 0, for example 0:100 or 10::2."
        )
    start, stop, step = (int(part) if part else None for part in (*parts, "")[:3])
    if step == 0:
        raise InputError(f"{_FRAMES}{text!r} has a step of 0; the step must be 1 or more.")
    selection = range(start or 0, sys.maxsize if stop is None else stop, step or 1)
    if not selection:
        raise InputError(f"{_FRAMES}{text!r} selects no frame because STOP is not greater than START.")
    return range(selection.start, selection[-1] + 1, selection.step)


def within(selection: range, count: int) -> range:
    """The part of ``selection`` that a source of ``count`` frames can give."""
    return range(selection.start, min(selection.stop, count), selection.step)


def natural_order(path: Path) -> tuple[list[str | int], str]:
    """Sort key that puts ``2.png`` before ``10.png``: digits compare as numbers, letters without case."""
    # Splitting at a capturing group alternates text and digits, so that only like is compared with like.
    parts = re.split("([0-9]+)", path.as_posix().casefold())
    return [int(part) if position % 2 else part for position, part in enumerate(parts)], path.as_posix()
