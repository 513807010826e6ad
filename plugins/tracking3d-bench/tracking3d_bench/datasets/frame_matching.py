"""Matching files to the frames of a sequence."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from tracking3d.errors import InputError

Rule = Literal["number", "name", "order"]


def number_of(file: Path) -> int | None:
    """The last number in a file's name without suffix; None if it has none."""
    numbers = re.findall("[0-9]+", file.stem)
    return int(numbers[-1]) if numbers else None


def frame_numbers(frames: Sequence[Path]) -> dict[int, int]:
    """Index of each frame by its number.

    Raises:
        InputError: If a name holds no number, or two the same.
    """
    index: dict[int, int] = {}
    for n, frame in enumerate(frames):
        number = number_of(frame)
        if number is None or number in index:
            other = "no number" if number is None else f"the same number as {frames[index[number]].name}"
            raise InputError(
                f"The frame {frame} has {other} in its name; set the description to match frames by name or order."
            )
        index[number] = n
    return index


def match_frames(
    files: Sequence[Path], frames: Sequence[Path], rule: Rule, every: int = 1
) -> dict[int, Path]:
    """The file of each frame that has one, by frame index.

    Args:
        files: In their order. Those that belong to no frame are left out.
        frames: All frames of the sequence in order.
        rule: By the last number in their names, by their names without suffix, or by their order.
        every: With the rule ``order``, file n belongs to frame ``n * every``.

    Raises:
        InputError: If two files belong to the same frame, see also `frame_numbers`.
    """
    if rule == "order":
        return {n * every: file for n, file in enumerate(files) if n * every < len(frames)}
    index: Mapping[Any, int] = (
        frame_numbers(frames) if rule == "number" else {frame.stem: n for n, frame in enumerate(frames)}
    )
    matched: dict[int, Path] = {}
    for file in files:
        frame = index.get(number_of(file) if rule == "number" else file.stem)
        if frame is None:
            continue
        if frame in matched:
            raise InputError(
                f"{matched[frame]} and {file} both belong to the frame {frames[frame].name}; remove one of them."
            )
        matched[frame] = file
    return matched
