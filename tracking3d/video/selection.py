"""The selection of frames, and the order of files."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from tracking3d.errors import InputError, argument

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
