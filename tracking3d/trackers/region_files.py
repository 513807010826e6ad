"""Text files with the object's rectangle, polygon or mask in every frame, one per line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from tracking3d.errors import InputError
from tracking3d.trackers.vot_regions import (
    EncodedMask,
    Polygon,
    Rectangle,
    Region,
    Special,
    parse_numbers,
    parse_region,
)

Form = Literal["vot", "xywh", "xyxy", "polygon"]


def read_regions(
    file: Path,
    form: Form = "vot",
    *,
    header_lines: int = 0,
    frame_column: int | None = None,
    first_column: int = 0,
    one_based: bool = False,
) -> dict[int, Region]:
    """Read a file with a region a line; commas, semicolons and spaces separate columns.

    Args:
        file: Empty lines at its end do not count.
        form: What a line holds; ``vot`` decides line by line, see `tracking3d.trackers.vot_regions`.
        header_lines: Number of lines to leave out at the start.
        frame_column: Column, from 0, of the frame's number. Else line n is frame n.
        first_column: Column, from 0, where the region begins.
        one_based: Whether the first pixel is 1 instead of 0.

    Returns:
        The regions by the number of their line, from 0, or by what ``frame_column`` says.

    Raises:
        InputError: If it cannot be read as text, or a line is damaged; names file and line.
    """
    try:
        lines = file.read_text(encoding="utf-8").rstrip().splitlines()[header_lines:]
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as text ({error}); restore it.") from error
    regions: dict[int, Region] = {}
    for n, line in enumerate(lines):
        try:
            if not line.strip():
                raise ValueError("it is empty")
            number = n if frame_column is None else int(parse_numbers(line)[frame_column])
            if number in regions:
                raise ValueError(f"frame {number} comes twice")
            region = _FORMS[form](_without_columns(line, first_column))
        except (ValueError, IndexError, OverflowError) as error:
            reason = "a column is missing" if isinstance(error, IndexError) else error
            raise InputError(f"{file}, line {n + 1 + header_lines}: {reason}; correct that line.") from error
        regions[number] = _shift(region, -1) if one_based else region
    return regions


def _without_columns(line: str, columns: int) -> str:
    return ",".join(repr(number) for number in parse_numbers(line)[columns:]) if columns else line


def _rectangle(line: str) -> Region:
    x, y, width, height = _four(line)
    return _finite(Rectangle(x, y, width, height), x, y, width, height)


def _corners(line: str) -> Region:
    x0, y0, x1, y1 = _four(line)
    return _finite(Rectangle(x0, y0, x1 - x0, y1 - y0), x0, y0, x1, y1)


def _polygon(line: str) -> Region:
    region = parse_region(line)
    if not isinstance(region, Polygon | Special):
        raise ValueError("it is not a polygon")
    return region


_FORMS: Mapping[str, Callable[[str], Region]] = {
    "vot": parse_region,
    "xywh": _rectangle,
    "xyxy": _corners,
    "polygon": _polygon,
}


def _four(line: str) -> list[float]:
    numbers = parse_numbers(line)
    if len(numbers) != 4:
        raise ValueError(f"it has {len(numbers)} numbers instead of 4")
    return numbers


def _finite(region: Rectangle, *numbers: float) -> Region:
    if np.isinf(numbers).any():
        raise ValueError("a number is infinite")
    return Special(0) if np.isnan(numbers).any() else region


def _shift(region: Region, by: int) -> Region:
    match region:
        case Rectangle():
            return replace(region, x=region.x + by, y=region.y + by)
        case Polygon():
            return Polygon(tuple((x + by, y + by) for x, y in region.points))
        case EncodedMask():
            return replace(region, left=region.left + by, top=region.top + by)
    return region
