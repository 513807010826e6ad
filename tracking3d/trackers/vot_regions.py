"""Regions as VOT writes them, one a line: rectangles, polygons, run-length encoded masks and special codes.

::

    12,30,40.5,20                    a rectangle: x, y, width, height
    12,30,52,30,52,50,12,50          a polygon: x and y of its corners
    m12,30,3,2,1,2,3                 a mask: x, y, width and height of a box, then the lengths of runs in it, row by
                                     row, of 0 and 1 in turn, 0 first; what is left of the box is 0
    0  or  nan,nan,nan,nan           no region, and so is a rectangle without width or height

Source: vot-toolkit, ``vot/region/io.py`` (https://github.com/votchallenge/toolkit).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import floor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box

_SEPARATOR = re.compile(r"\s*[,;\s]\s*")
_MOST_PIXELS = 2**28


@dataclass(frozen=True)
class Rectangle:
    """``x`` and ``y`` of the left upper corner, ``width`` and ``height``, in pixels."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Polygon:
    """``(x, y)`` of three or more corners in pixels."""

    points: tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class EncodedMask:
    """A mask within a box; what is outside is 0.

    Attributes:
        left, top, width, height: The box in whole pixels; it may reach beyond the frame.
        runs: ``(R,)`` lengths of runs of 0 and 1 in turn, 0 first, row by row.
    """

    left: int
    top: int
    width: int
    height: int
    runs: NDArray[np.int64]


@dataclass(frozen=True)
class Special:
    """No region. In ground truth, 0 is an unknown state and 1 an object that is not seen."""

    code: int


Region = Rectangle | Polygon | EncodedMask | Special


def parse_region(text: str) -> Region:
    """Read one region; commas, semicolons and spaces separate numbers.

    Raises:
        ValueError: If it is no region; says why.
    """
    text = text.strip()
    if text.startswith("m"):
        return _parse_mask(_SEPARATOR.split(text[1:]))
    numbers = parse_numbers(text)
    if np.isnan(numbers).any():
        return Special(0)
    if not np.isfinite(numbers).all():
        raise ValueError("a number is infinite")
    if len(numbers) == 1:
        return Special(int(numbers[0]))
    if len(numbers) == 4:
        if min(numbers[2:]) < 0:
            written = ",".join(f"{number:g}" for number in numbers)
            raise ValueError(f"the rectangle {written} has a negative width or height")
        return Rectangle(*numbers)
    if len(numbers) >= 6 and len(numbers) % 2 == 0:
        return Polygon(tuple(zip(numbers[::2], numbers[1::2], strict=True)))
    raise ValueError(f"{len(numbers)} numbers are not a region")


def parse_numbers(text: str) -> list[float]:
    """The numbers of a line; commas, semicolons and spaces separate them.

    Raises:
        ValueError: If it holds anything else; says what.
    """
    numbers = []
    for token in _SEPARATOR.split(text.strip()):
        try:
            numbers.append(float(token))
        except ValueError as error:
            raise ValueError(f"{token!r} is not a number" if token else "a number is missing") from error
    return numbers


def format_region(region: Region) -> str:
    """The line that `parse_region` reads."""
    match region:
        case Rectangle():
            return f"{region.x},{region.y},{region.width},{region.height}"
        case Polygon():
            return ",".join(f"{x},{y}" for x, y in region.points)
        case EncodedMask():
            numbers = [region.left, region.top, region.width, region.height, *region.runs]
            return "m" + ",".join(str(number) for number in numbers)
        case Special():
            return str(region.code)


def encode_mask(mask: NDArray[np.bool_]) -> EncodedMask:
    """Encode ``mask`` ``(H, W)`` within its bounding box; an empty one has a box without size."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    pixels = mask[top : top + height, left : left + width].astype(bool).ravel()
    changes = np.flatnonzero(np.diff(pixels, prepend=False, append=~pixels[-1:]))
    return EncodedMask(
        left, top, width, height, np.diff(changes, prepend=0) if len(pixels) else np.zeros(1, np.int64)
    )


def decode_mask(mask: EncodedMask) -> NDArray[np.bool_]:
    """The mask within its box, ``(height, width)``."""
    pixels = np.zeros(mask.width * mask.height, dtype=bool)
    values = np.repeat(np.arange(len(mask.runs)) % 2 == 1, mask.runs)
    pixels[: len(values)] = values
    return pixels.reshape(mask.height, mask.width)


def rasterise(region: Region, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """The region's pixels in a frame of ``shape`` ``(H, W)``; what reaches beyond it is cut off.

    A rectangle covers the columns from ``x`` to ``x + width - 1``, both rounded down, and rows alike, as in the VOT
    toolkit. A polygon's corners are rounded to pixels and its outline belongs to it (`cv2.fillPoly`); the toolkit
    rounds down where an edge crosses a row, so that its outline may be a pixel further left.
    """
    height, width = shape
    canvas = np.zeros(shape, dtype=bool)
    match region:
        case Rectangle() if region.width > 0 and region.height > 0:
            right, bottom = floor(region.x + region.width), floor(region.y + region.height)
            canvas[max(floor(region.y), 0) : max(bottom, 0), max(floor(region.x), 0) : max(right, 0)] = True
        case Polygon():
            corners = np.round(np.clip(region.points, -(2**14), 2**14)).astype(np.int32)
            return cv2.fillPoly(canvas.astype(np.uint8), [corners], 1).astype(bool)
        case EncodedMask():
            x0, y0 = max(region.left, 0), max(region.top, 0)
            x1, y1 = min(region.left + region.width, width), min(region.top + region.height, height)
            if x1 > x0 and y1 > y0:
                inside = decode_mask(region)
                canvas[y0:y1, x0:x1] = inside[
                    y0 - region.top : y1 - region.top, x0 - region.left : x1 - region.left
                ]
    return canvas


def bounding_box(region: Region) -> Box | None:
    """``(x, y, width, height)`` around it, not cut off at the frame; None if it has no area."""
    box = 0.0, 0.0, 0.0, 0.0
    match region:
        case Rectangle():
            box = region.x, region.y, region.width, region.height
        case Polygon():
            (x0, y0), (x1, y1) = (
                np.min(region.points, axis=0).tolist(),
                np.max(region.points, axis=0).tolist(),
            )
            box = x0, y0, x1 - x0, y1 - y0
        case EncodedMask():
            x, y, width, height = cv2.boundingRect(decode_mask(region).astype(np.uint8))
            box = float(region.left + x), float(region.top + y), float(width), float(height)
    return box if box[2] > 0 and box[3] > 0 else None


def _parse_mask(tokens: list[str]) -> EncodedMask:
    try:
        numbers = np.array(tokens).astype(np.int64)
    except (ValueError, OverflowError) as error:
        raise ValueError("a mask must hold only whole numbers") from error
    if len(numbers) < 5:
        raise ValueError("a mask needs x, y, width, height and runs")
    left, top, width, height = numbers[:4].tolist()
    runs = numbers[4:]
    if min(width, height) < 0 or (runs < 0).any():
        raise ValueError("a mask must not have negative sizes or runs")
    if width * height > _MOST_PIXELS:
        raise ValueError(f"the mask's box of {width} x {height} pixels is larger than any frame")
    if runs.sum() > width * height:
        raise ValueError(f"the runs of the mask are longer than its box of {width} x {height} pixels")
    return EncodedMask(left, top, width, height, runs)


_LONGEST = 1 << 30


class RegionMasks:
    """The regions of a file; line n is frame n of the source, from 0. See `tracking3d.trackers.vot_regions`.

    Args:
        path: The file.

    Raises:
        InputError: If it cannot be read, or a line is no region; names the line.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.names: Sequence[str] = ()
        self.regions = _read(path)
        self._size: tuple[int, int] = (0, 0)

    @property
    def has_rectangles(self) -> bool:
        """Whether one of the regions is a rectangle, which is no mask."""
        return any(isinstance(region, Rectangle) for region in self.regions)

    def in_frames(self, size: tuple[int, int]) -> None:
        """Let masks be of frames of ``size`` ``(H, W)``, which a region does not tell."""
        self._size = size

    def label(self, position: int) -> str:
        """The file's path and the line."""
        return f"{self._path}, line {position + 1}"

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`."""
        if position >= len(self.regions) or isinstance(self.regions[position], Special):
            return None
        return rasterise(self.regions[position], self._size)

    def box(self, position: int) -> Box | None:
        """The box around region ``position``; None beyond the last, and if there is none."""
        return bounding_box(self.regions[position]) if position < len(self.regions) else None


def box_in_file(path: Path, index: int, label: str) -> Box:
    """The box of frame ``index`` in a file of regions, which sentences call ``label``.

    Raises:
        InputError: If the file holds none.
    """
    box = RegionMasks(path).box(index)
    if box is None:
        raise InputError(f"{label} has no box in line {index + 1} for frame {index}.")
    return box


def _read(path: Path) -> list[Region]:
    try:
        if path.stat().st_size > _LONGEST:
            raise InputError(f"{path} is larger than {_LONGEST >> 30} GiB, too large for regions.")
        lines = path.read_text(encoding="utf-8-sig").rstrip().splitlines()
    except (OSError, ValueError) as error:
        raise InputError(f"The regions file {path} cannot be read as text; restore it.") from error
    if not lines:
        raise InputError(f"The regions file {path} is empty; give one region per line.")
    regions = []
    for number, line in enumerate(lines, 1):
        try:
            regions.append(parse_region(line))
        except (ValueError, OverflowError) as error:
            raise InputError(
                f"{path}, line {number}: {error}; give a VOT rectangle, polygon or mask in every line."
            ) from error
    return regions
