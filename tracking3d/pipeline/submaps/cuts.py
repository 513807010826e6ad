"""Cuts of a long video: at frames that show the object well, and so that the parts have about the same length."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, argument

SPLIT = argument("split=", "--split ")
"""What sentences call the length of a part, before its value."""
_SLACK = 0.25  # of a part's length, that a cut may be moved to either side
_OVERLAP = 0.25  # of a part's length
_LEAST_OVERLAP, _MOST_OVERLAP = 12, 90  # frames
_FEWEST_FRAMES = 24
"""Frames of a part: it has to initialize the object's shape by itself."""
_GOOD = 0.25
_DISTANCE = 0.2  # what a cut at the end of its window is worth less than one in the middle
_CHANGE = 2.0  # what a change of the mask's area from one preview frame to the next subtracts, per natural logarithm


@dataclass(frozen=True, eq=False)
class Sighting:
    """The object in a frame of the preview."""

    position: int  # position of the frame among the selected ones, from 0
    area: int  # pixels of the mask, at the common resolution of all sightings; 0 if there is none
    touches_border: bool  # whether the mask comes up to the image's border
    score: float  # confidence of the mask, in [0, 1]
    mask: NDArray[np.bool_] | None = None  # (H, W) bool at that resolution; None if it is not kept


@dataclass(frozen=True)
class Part:
    """A stretch of the selected frames."""

    number: int  # from 0
    start: int  # position of its first frame
    stop: int  # one past its last
    # position of the first frame whose estimate the merged run takes from it: frames that the part before
    # tracked as well keep the estimates of that one, whose model has seen more
    owns_from: int


def parse_length(text: str, fps: float | None) -> int:
    """Frames of a part, from seconds (``90``) or frames (``900f``).

    Raises:
        InputError: If it is neither, not positive, or in seconds if the source has no frame rate.
    """
    match = re.fullmatch(r"\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*(f|s)?\s*", text, re.IGNORECASE | re.ASCII)
    try:
        value = math.nan if match is None else float(match[1])
    except ValueError:
        value = math.nan
    if match is None or not math.isfinite(value) or value <= 0:
        raise InputError(
            f"{SPLIT}{text} is no length of a part; give seconds, such as 60, or frames, such as 900f."
        )
    if (match[2] or "s").lower() == "f":
        frames = value
    elif fps is None:
        raise InputError(f"{SPLIT}{text}: the source has no rate; give the length in frames, such as 900f.")
    else:
        frames = value * fps
    if frames < _FEWEST_FRAMES:
        raise InputError(
            f"{SPLIT}{text} makes parts of {frames:.0f} frames; a part needs at least {_FEWEST_FRAMES} to model the "
            "object's shape."
        )
    return round(min(frames, 2**53))


def windows(count: int, length: int) -> list[range]:
    """Positions among which each cut may be, one window for each cut; none if the video is one part.

    Parts are as near to ``length`` as ``count`` frames in equal parts can be; a rest of less than half of it is no
    part of its own.
    """
    parts = max(round(count / length), 1)
    share = count / parts
    slack = math.floor(_SLACK * share)
    middles = [round(number * share) for number in range(1, parts)]
    return [range(middle - slack, middle + slack + 1) for middle in middles]


def cuts_in(sightings: Sequence[Sighting], allowed: Sequence[range]) -> list[Sighting]:
    """The sighting at which each cut is made; fewer than windows if the object is not seen well in one."""
    chosen = []
    for window in allowed:
        inside = [one for one in sightings if one.position in window]
        qualities = _qualities(inside)
        middle, reach = (window.start + window.stop - 1) / 2, max(len(window) / 2, 1)
        worth = [
            quality - _DISTANCE * abs(one.position - middle) / reach if quality >= _GOOD else -math.inf
            for one, quality in zip(inside, qualities, strict=True)
        ]
        best = int(np.argmax(worth)) if worth else 0
        if worth and math.isfinite(worth[best]):
            chosen.append(inside[best])
    return chosen


def _qualities(sightings: Sequence[Sighting]) -> list[float]:
    """How well each shows the object, in [0, 1].

    A mask much smaller than is usual nearby is hidden in part, and one whose area just changed was, or will be.
    """
    areas = [one.area for one in sightings]
    usual = float(np.median([area for area in areas if area])) if any(areas) else 1.0
    qualities = []
    for n, one in enumerate(sightings):
        quality = 0.0
        if one.area and not one.touches_border:
            beside = [area for area in areas[max(n - 1, 0) : n + 2] if area]
            change = math.log(max(beside) / min(beside))
            quality = one.score * min(one.area / usual, 1.0) * max(1.0 - _CHANGE * change, 0.0)
        qualities.append(quality)
    return qualities


def overlap_of(length: int) -> int:
    """Frames that two parts of ``length`` frames have in common."""
    return min(max(round(_OVERLAP * length), _LEAST_OVERLAP), _MOST_OVERLAP)


def parts_at(cuts: Sequence[int], count: int, overlap: int) -> list[Part]:
    """The parts of ``count`` frames that begin at 0 and at the cuts, each going on beyond the next cut."""
    starts = [0, *cuts]
    stops = [min(cut + overlap, count) for cut in cuts] + [count]
    owned = [0, *(min(cut + overlap, count) for cut in cuts)]
    return [
        Part(number, start, stop, owns_from)
        for number, (start, stop, owns_from) in enumerate(zip(starts, stops, owned, strict=True))
    ]
