"""Points followed from frame to frame by optical flow, and found again between keyframes by their descriptors."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MOST_POINTS = 250
"""Points that a frame gets at least, where it has so many corners."""
MOST_FOLLOWED = 350
"""Points that are followed at once."""
_QUALITY = 0.01  # of the strongest corner, see cv2.goodFeaturesToTrack
_FLOW_WINDOW = (15, 15)
_FLOW_LEVELS = 3
_ROUND_TRIP = 0.7  # pixels that a point followed there and back may miss itself by


@dataclass(frozen=True, eq=False)
class FollowedPoints:
    """Points of the surface as one frame shows them.

    Attributes:
        landmark: ``(N,)`` int64, which landmark each is.
        pixel: ``(N, 2)`` float32 in the full frame.
    """

    landmark: NDArray[np.int64]
    pixel: NDArray[np.float32]

    @classmethod
    def none(cls) -> FollowedPoints:
        """No points."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))

    def __len__(self) -> int:
        return len(self.landmark)

    def spread(self, most: int, size: float) -> FollowedPoints:
        """At most so many: one in every square of ``size`` / 20 pixels, the oldest, then others by age."""
        if len(self) <= most:
            return self
        cell = np.floor(self.pixel / max(size / 20, 1.0)).astype(np.int64)
        _, first = np.unique(cell, axis=0, return_index=True)
        rest = np.setdiff1d(np.arange(len(self)), first)
        kept = np.sort(np.concatenate([first, rest])[:most])
        return FollowedPoints(self.landmark[kept], self.pixel[kept])

    def only(self, kept: NDArray[np.bool_]) -> FollowedPoints:
        """Those that are kept."""
        return FollowedPoints(self.landmark[kept], self.pixel[kept])


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """``(H, W)`` brightness of ``(H, W, 3)`` RGB."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def follow(
    before: NDArray[np.uint8],
    now: NDArray[np.uint8],
    points: FollowedPoints,
    guess: NDArray[np.float32] | None = None,
) -> FollowedPoints:
    """Where points have gone, by pyramidal Lucas-Kanade flow there and back.

    Args:
        before: ``(H, W)`` grey image of the earlier frame.
        now: ``(H, W)`` grey image of the later one.
        points: In the earlier frame.
        guess: ``(N, 2)`` where they are expected; where they were if None.

    Returns:
        Those that came back to where they had been.
    """
    if not len(points):
        return points
    start = points.pixel[:, None]
    flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
    there = None if guess is None else guess.astype(np.float32)[:, None].copy()
    options = {"winSize": _FLOW_WINDOW, "maxLevel": _FLOW_LEVELS}
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, now, start, there, flags=flags, **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        now, before, there, start.copy(), flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options
    )
    miss = np.linalg.norm(back - start, axis=2)[:, 0]
    height, width = now.shape
    x, y = there[:, 0].T
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    kept = (found[:, 0] > 0) & (found_back[:, 0] > 0) & (miss < _ROUND_TRIP) & inside
    return FollowedPoints(points.landmark[kept], there[kept, 0])


def new_corners(
    image: NDArray[np.uint8], mask: NDArray[np.bool_], taken: NDArray[np.float32], most: int
) -> NDArray[np.float32]:
    """``(N, 2)`` corners inside a mask, away from its outline and from points that are there already.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)``.
        taken: ``(M, 2)`` pixels of points that are there.
        most: How many at most.
    """
    if most <= 0 or not mask.any():
        return np.zeros((0, 2), np.float32)
    size = float(np.sqrt(mask.sum()))
    distance = max(size / 25, 3.0)
    margin = max(round(0.02 * size), 2)
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    box = slice(y, y + height), slice(x, x + width)
    inside = cv2.copyMakeBorder(mask[box].astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    inside = cv2.erode(inside, np.ones((3, 3), np.uint8), iterations=margin, borderValue=0)[1:-1, 1:-1]
    for px, py in taken:
        cv2.circle(inside, (round(float(px)) - x, round(float(py)) - y), round(distance), 0, -1)
    crop = np.ascontiguousarray(image[box])
    if min(crop.shape) < 16:
        return np.zeros((0, 2), np.float32)
    corners = cv2.goodFeaturesToTrack(crop, most, _QUALITY, distance, mask=inside)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    found = cv2.cornerSubPix(
        crop, corners, (3, 3), (-1, -1), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
    )
    offset = np.array([x, y], np.float32)
    return np.asarray(np.where(np.abs(found - corners) < 2, found, corners)[:, 0] + offset, dtype=np.float32)
