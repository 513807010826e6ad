"""Cut-outs with gaps: gratings, windows, notches, frames and legs, so that the background is seen through them."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Shape = NDArray[np.uint8]

_MOST = 6
_FINE = 3
"""Gaps are drawn so many times as large, for smooth outlines."""

_KEPT, _CUT = 0.15, 0.03
"""At least this share of the cut-out has to remain, and at least this share to be cut."""

_TURNED = 0.35
"""Share of the gaps that are not parallel to the picture's sides."""


def with_gaps(layer: Image, rng: np.random.Generator) -> Image:
    """A cut-out ``(h, w, 4)`` with 1 to `_MOST` gaps in its alpha; as it was if nothing of it would remain."""
    alpha = layer[..., 3]
    gaps = np.zeros((_FINE * alpha.shape[0], _FINE * alpha.shape[1]), np.uint8)
    if rng.random() < 0.3:
        _skeleton(gaps, alpha, rng)
    else:
        kinds: tuple[Callable[..., None], ...] = (_grating, _window, _ellipse, _notch)
        for _ in range(int(rng.integers(1, _MOST + 1))):
            draw = kinds[int(rng.choice(len(kinds), p=[0.35, 0.25, 0.2, 0.2]))]
            draw(gaps, _place(alpha, rng), rng)
            if draw is _grating:
                break  # a grating is several gaps
    open_ = cv2.resize(gaps, alpha.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    left = _largest_part(alpha * (1 - open_))
    whole = float(alpha.sum())
    if left.sum() < _KEPT * whole or left.sum() > (1 - _CUT) * whole:
        return layer
    return np.dstack([layer[..., :3], np.round(left).astype(np.uint8)])


def _largest_part(alpha: NDArray[np.float32]) -> NDArray[np.float32]:
    """Without what the gaps have cut off."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((alpha > 127).astype(np.uint8))
    if len(stats) < 3:
        return alpha
    largest = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    rim = cv2.dilate(largest.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return np.where(rim & ((labels == 0) | largest), alpha, 0)


def _place(alpha: Shape, rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Centre and size of a gap in the fine picture; the centre is on the cut-out."""
    rows, columns = np.nonzero(alpha > 127)
    if not len(rows):
        rows, columns = np.array([alpha.shape[0] // 2]), np.array([alpha.shape[1] // 2])
    index = int(rng.integers(len(rows)))
    width, height = rng.uniform(0.1, 0.75, 2) * (np.ptp(columns) + 1, np.ptp(rows) + 1)
    return _FINE * float(columns[index]), _FINE * float(rows[index]), _FINE * width, _FINE * height


def _angle(rng: np.random.Generator) -> float:
    return float(rng.uniform(0, 180)) if rng.random() < _TURNED else 0.0


def _window(gaps: Shape, place: tuple[float, float, float, float], rng: np.random.Generator) -> None:
    """A rectangle, often with round corners."""
    x, y, width, height = place
    radius = rng.uniform(0, 0.5) * min(width, height) if rng.random() < 0.5 else 0.0
    _fill(gaps, (x, y), (width, height), _angle(rng), radius)


def _ellipse(gaps: Shape, place: tuple[float, float, float, float], rng: np.random.Generator) -> None:
    x, y, width, height = place
    axes = max(int(width / 2), 2), max(int(height / 2), 2)
    cv2.ellipse(gaps, (round(x), round(y)), axes, _angle(rng), 0, 360, 255, -1)


def _notch(gaps: Shape, place: tuple[float, float, float, float], rng: np.random.Generator) -> None:
    """A cut from beyond the outline to a point inside, its end square, round or pointed."""
    x, y, width, height = place
    narrow = max(min(width, height) / 2, 4.0)
    angle = float(rng.choice([0, 90, 180, 270])) if rng.random() < 0.6 else rng.uniform(0, 360)
    along = np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    across = np.array([-along[1], along[0]])
    tip, end = np.array([x, y]), np.array([x, y]) + 2 * max(gaps.shape) * along
    pointed = rng.uniform(0, 1) if rng.random() < 0.3 else 1.0
    flare = 1.0 if pointed == 1.0 else rng.uniform(2, 8)
    corners = [
        tip + pointed * narrow * across, tip - pointed * narrow * across,
        end - flare * narrow * across, end + flare * narrow * across,
    ]  # fmt: skip
    cv2.fillPoly(gaps, [np.round(corners).astype(np.int32)], 255)
    if rng.random() < 0.4:
        cv2.circle(gaps, (round(x), round(y)), round(pointed * narrow), 255, -1)


def _grating(gaps: Shape, place: tuple[float, float, float, float], rng: np.random.Generator) -> None:
    """Parallel gaps of one width, as between columns, slats or spokes of a rack."""
    x, y, width, height = place
    width, height = max(1.4 * width, 0.3 * gaps.shape[1]), max(1.3 * height, 0.3 * gaps.shape[0])
    if rng.random() < 0.3:
        width, height, turn = height, width, 90.0
    else:
        turn = 0.0
    turn += rng.normal(0, 8) if rng.random() < _TURNED else 0.0
    number = int(rng.integers(2, 9))
    period = width / number
    open_ = rng.uniform(0.25, 0.75) * period
    radius = rng.choice([0.0, 0.5]) * open_
    cosine, sine = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    for index in range(number):
        away = (index - (number - 1) / 2) * period
        _fill(gaps, (x + away * cosine, y + away * sine), (open_, height), turn, radius)


def _skeleton(gaps: Shape, alpha: Shape, rng: np.random.Generator) -> None:
    """So much is cut that a frame remains, or a slab on legs, or nothing but columns."""
    rows, columns = np.nonzero(alpha > 127)
    if not len(rows):
        return
    left, top = _FINE * float(columns.min()), _FINE * float(rows.min())
    width, height = _FINE * float(np.ptp(columns) + 1), _FINE * float(np.ptp(rows) + 1)
    kind = rng.random()
    if kind < 0.35:  # a rim of the outline's own shape
        thick = max(int(rng.uniform(0.06, 0.2) * min(width, height)), 3)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * thick + 1, 2 * thick + 1))
        padded = cv2.copyMakeBorder((alpha > 127).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
        large = cv2.resize(padded, None, fx=_FINE, fy=_FINE, interpolation=cv2.INTER_NEAREST)
        gaps |= 255 * cv2.erode(large, disc)[_FINE:-_FINE, _FINE:-_FINE]
        return
    number = int(rng.integers(1, 7))
    column = rng.uniform(0.06, 0.2) * width / number
    slab = rng.uniform(0.1, 0.6) * height
    foot = 0.0 if kind < 0.7 else rng.uniform(0.06, 0.2) * height
    period = (width - column) / number
    tall = max(height - slab - foot, 4.0)
    for index in range(number):
        x = left + column / 2 + (index + 0.5) * period
        extra = 0.0 if foot else height  # legs are open below
        _fill(gaps, (x, top + slab + (tall + extra) / 2), (period - column, tall + extra), 0.0, 0.0)


def _fill(
    gaps: Shape, centre: tuple[float, float], size: tuple[float, float], angle: float, radius: float
) -> None:
    """Draw a rectangle with round corners."""
    inner = [max(length - 2 * radius, 0.0) for length in size]
    corners = cv2.boxPoints((centre, inner, angle))
    if radius >= 1:
        cv2.polylines(gaps, [np.round(corners).astype(np.int32)], True, 255, max(round(2 * radius), 1))
    cv2.fillPoly(gaps, [np.round(corners).astype(np.int32)], 255)
