"""Tracked points drawn over the frames: the position of each and its trail."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from tracking3d.frames import Frame, Image, SkippedFrame
from tracking3d.results.correspondences import PointTracks
from tracking3d.results.drawing import Colour
from tracking3d.runtime.progress import report_each
from tracking3d.video import VideoWriter

TRAIL = 6
"""Length of a trail in frames."""
SMALLEST_SIDE = 480
"""Frames whose longer side is shorter are enlarged."""
_SHIFT = 4  # binary digits of OpenCV's fractions of pixels


def draw_trails(image: Image, tracks: PointTracks, row: int) -> Image:
    """One frame with its points; what is seen is filled, what is hidden a ring, both with the way they came.

    Args:
        image: ``(H, W, 3)`` RGB; is not changed.
        tracks: The points.
        row: Which of ``tracks.frames`` it is.
    """
    factor = max(1, round(SMALLEST_SIDE * 1.5 / max(image.shape[:2])))
    drawn = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC)
    radius = max(2, round(max(drawn.shape[:2]) / 250))
    for point, colour in enumerate(_colours(tracks)):
        way = [(tracks.positions[at, point] + 0.5) * factor - 0.5 for at in range(max(row - TRAIL, 0), row + 1)
               if tracks.visible[at, point] and np.isfinite(tracks.positions[at, point]).all()]  # fmt: skip
        if len(way) > 1:
            cv2.polylines(drawn, [_fixed_points(np.stack(way))], False, colour, 1, cv2.LINE_AA, _SHIFT)
        here = (tracks.positions[row, point] + 0.5) * factor - 0.5
        if not np.isfinite(here).all() or (abs(here) > 2 * max(drawn.shape)).any():
            continue
        thickness = cv2.FILLED if tracks.visible[row, point] else 1
        x, y = _fixed_points(here).tolist()
        cv2.circle(drawn, (x, y), radius << _SHIFT, colour, thickness, cv2.LINE_AA, _SHIFT)
    return drawn


def write_trails(path: Path, frames: Iterable[Frame | SkippedFrame], tracks: PointTracks, fps: float) -> None:
    """Write a video of all frames with their points.

    Raises:
        OutputError: If it cannot be written.
        InputError: If the frames cannot be read.
    """
    rows = {int(index): row for row, index in enumerate(tracks.frames)}
    writer: VideoWriter | None = None
    try:
        for frame in report_each("drawing", frames, len(rows)):
            if isinstance(frame, Frame) and frame.index in rows:
                drawn = draw_trails(frame.image, tracks, rows[frame.index])
                writer = writer or VideoWriter(path, fps, (drawn.shape[0], drawn.shape[1]))
                writer.write(drawn)
    finally:
        if writer is not None:
            writer.close()


def _colours(tracks: PointTracks) -> list[Colour]:
    """A hue for each point, by the direction in which it lies from the middle of all."""
    away = tracks.query - tracks.query.mean(0)
    hues = np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) % 1
    colours = (colorsys.hsv_to_rgb(hue, 0.9, 1.0) for hue in hues)
    return [(round(255 * r), round(255 * g), round(255 * b)) for r, g, b in colours]


def _fixed_points(xy: np.ndarray) -> np.ndarray:
    return np.round(xy * (1 << _SHIFT)).astype(np.int32)
