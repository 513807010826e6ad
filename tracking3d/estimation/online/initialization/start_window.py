"""Where in a video an object is best to start with: whole, with texture that can be followed, while it turns."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import MOST_POINTS, FollowedPoints, follow, new_corners
from tracking3d.estimation.online.initialization.structure_from_motion import image_deformation
from tracking3d.points.bundle_adjustment.adjustment import Tracks

_EVERY = 10  # frames from one window to the next
_LENGTH = 45  # frames of a window
_ENOUGH_DEFORMATION = 0.1  # image deformation from which more does not make a start better

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(eq=False)
class _Window:
    """Points that are followed from one frame on."""

    start: int  # index of the frame
    area: int  # pixels of its mask
    first: NDArray[np.float32]  # (N, 2) the points there
    # those that are followed still; their numbers are rows of first
    points: FollowedPoints = field(default_factory=FollowedPoints.none)
    score: float = 0.0  # see `score_starts`, without the area


def score_starts(frames: Iterable[tuple[int, Image, Mask | None]]) -> dict[int, float]:
    """How good it is to start at some of the frames, by their index, in [0, 1].

    The score is the share of `MOST_POINTS` that are followed to a later frame of the window, times how far their image
    has changed its form there (see `image_deformation`), times the area of the mask relative to the largest: an object
    that is near, sharp, textured and free of hands, and turns soon, has the highest.

    Args:
        frames: Index, grey image ``(H, W)`` and mask ``(H, W)`` of frames in order of time; every second frame will do.
    """
    done, open_windows = list[_Window](), list[_Window]()
    before: Image | None = None
    for index, image, mask in frames:
        if before is not None:
            for window in open_windows:
                window.points = follow(before, image, window.points)
                window.score = max(window.score, _score(window))
        done += [window for window in open_windows if index - window.start >= _LENGTH]
        open_windows = [window for window in open_windows if index - window.start < _LENGTH]
        latest = max((window.start for window in (*done, *open_windows)), default=index - _EVERY)
        if mask is not None and index - latest >= _EVERY:
            corners = new_corners(image, mask, np.zeros((0, 2), np.float32), MOST_POINTS)
            points = FollowedPoints(np.arange(len(corners)), corners)
            open_windows.append(_Window(index, int(np.count_nonzero(mask)), corners, points))
        before = image
    windows = [*done, *open_windows]
    largest = max((window.area for window in windows), default=1)
    return {window.start: window.score * window.area / largest for window in windows}


def _score(window: _Window) -> float:
    """The score of a window in the frame that its points have been followed to."""
    pixels = np.full((2, *window.first.shape), np.nan)
    pixels[0] = window.first
    pixels[1, window.points.landmark] = window.points.pixel
    deformation = image_deformation(Tracks(pixels, np.isfinite(pixels[..., 0])))
    return len(window.points) / MOST_POINTS * min(deformation / _ENOUGH_DEFORMATION, 1.0)
