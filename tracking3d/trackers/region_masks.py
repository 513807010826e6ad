"""Regions of a text file of VOT, one a line: masks and polygons as masks, rectangles as boxes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.trackers.vot_regions import Rectangle, Region, Special, bounding_box, parse_region, rasterise

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
