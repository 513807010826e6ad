"""Plots over the frames of a run, as paths of an SVG as wide as the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

WIDTH, HEIGHT = 1000.0, 100.0
"""The picture's own units: it is stretched to the page."""
MOST_POINTS = 2000
"""Points of a curve; if there are more frames, every n-th is drawn."""


@dataclass(frozen=True)
class Curve:
    """One figure over the frames."""

    title: str  # what it is
    # The curve as the d of an SVG path; it has gaps where there is no value. Values that stand alone are short
    # dashes.
    path: str
    low: str  # the figure at the lower edge, with its unit
    high: str  # that at the upper edge
    summary: str  # the curve in words, for who does not see it


def curve(
    title: str, values: ArrayLike, unit: str, limits: tuple[float, float] | None = None, digits: int = 2
) -> Curve | None:
    """Draw one figure a frame.

    Args:
        title: What it is.
        values: ``(N,)``; not finite if there is none.
        unit: Written behind the figures, with a space before it if it needs one.
        limits: Figures at the lower and the upper edge; the least and the greatest if None.
        digits: After the decimal point.

    Returns:
        The curve; None if there is not one figure.
    """
    y = np.asarray(values, dtype=np.float64)
    known = y[np.isfinite(y)]
    if not len(known):
        return None
    low, high = limits or (float(known.min()), float(known.max()))
    if high - low < 10.0**-digits:  # nothing to see but noise, which would fill the picture
        low, high = low - 10.0**-digits, high + 10.0**-digits

    def text(value: float) -> str:
        return f"{value:.{digits}f}{unit}"

    return Curve(
        title=title,
        path=path_of((y - low) / (high - low)),
        low=text(low),
        high=text(high),
        summary=f"{title}: from {text(known.min())} to {text(known.max())}, {text(known[-1])} at the end",
    )


def path_of(heights: NDArray[np.float64]) -> str:
    """The ``d`` of a path through ``(N,)`` heights, 0 at the lower and 1 at the upper edge; NaN breaks it."""
    step = max(len(heights) // MOST_POINTS, 1)
    parts: list[str] = []
    drawing = False
    for position in range(0, len(heights), step):
        height = heights[position]
        if not math.isfinite(height):
            drawing = False
            continue
        x = across(position, len(heights))
        y = HEIGHT * (1 - min(max(float(height), 0.0), 1.0))
        following = position + step
        alone = following >= len(heights) or not math.isfinite(heights[following])
        if drawing:
            parts.append(f"L{x:.1f} {y:.1f}")
        elif alone:
            parts.append(f"M{x - 1:.1f} {y:.1f}h2")
        else:
            parts.append(f"M{x:.1f} {y:.1f}")
        drawing = True
    return "".join(parts)


def across(position: int, count: int) -> float:
    """Where the middle of a frame is in the picture's width."""
    return WIDTH * (position + 0.5) / max(count, 1)


@dataclass(frozen=True)
class Stretch:
    """Frames in a row that share a status."""

    status: str  # what they share
    x: float  # left edge in the picture
    width: float  # width there


def stretches(statuses: Sequence[str]) -> list[Stretch]:
    """Frames in a row with one status, in order.

    Args:
        statuses: One a frame.
    """
    begins = [n for n in range(len(statuses)) if n == 0 or statuses[n] != statuses[n - 1]]
    unit = WIDTH / max(len(statuses), 1)
    return [
        Stretch(statuses[first], first * unit, (following - first) * unit)
        for first, following in pairwise([*begins, len(statuses)])
    ]
