"""Points tracked from frame to frame by optical flow (KLT), and new corners to track."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

MOST_POINTS = 250
"""The number of points that a frame is filled up to, if it has enough corners."""
MOST_FOLLOWED = 350
"""The most points that are tracked at once."""
_MIN_MASK_SIDE = 16  # smallest width and height in pixels of a mask in which corners are detected
_QUALITY = 0.01  # relative to the strongest corner, see cv2.goodFeaturesToTrack
_SUBPIXEL_WINDOW = (3, 3)  # pixels on every side
_MAX_SUBPIXEL_SHIFT = 2.0  # largest shift in pixels of a corner by the subpixel refinement
_SUBPIXEL_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)
_FLOW_WINDOW = (15, 15)
_FLOW_LEVELS = 3
_MAX_FORWARD_BACKWARD_ERROR = 0.7  # largest forward-backward error in pixels

_LEAST_CARRYING, _MOST_APART = 12, 2.0  # points, and pixels, that agree on how a mask moves (chosen)


@dataclass(frozen=True, eq=False)
class FollowedPoints:
    """Points of the surface in one frame."""

    landmark: NDArray[np.int64]  # (N,) int64, the index of each point's landmark
    pixel: NDArray[np.float32]  # (N, 2) float32 in the full frame

    @classmethod
    def none(cls) -> FollowedPoints:
        """No points."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 2), np.float32))

    def __len__(self) -> int:
        return len(self.landmark)

    def spread_out(self, most: int, size: float) -> FollowedPoints:
        """At most ``most`` points: the oldest one in every square of ``size`` / 20 pixels, then others by age.

        Points are sorted by age, the oldest first.
        """
        if len(self) <= most:
            return self
        cell = np.floor(self.pixel / max(size / 20, 1.0)).astype(np.int64)
        first = np.sort(np.unique(cell, axis=0, return_index=True)[1])
        rest = np.setdiff1d(np.arange(len(self)), first)
        kept = np.sort(np.concatenate([first, rest])[:most])
        return FollowedPoints(self.landmark[kept], self.pixel[kept])

    def concatenate(self, other: FollowedPoints) -> FollowedPoints:
        """These points, and those of another set whose landmarks are not among them."""
        new = ~np.isin(other.landmark, self.landmark)
        return FollowedPoints(
            np.concatenate([self.landmark, other.landmark[new]]),
            np.concatenate([self.pixel, other.pixel[new]]),
        )

    def only(self, kept: NDArray[np.bool_]) -> FollowedPoints:
        """The points at which ``kept`` ``(N,)`` is true."""
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
    """Track points by pyramidal Lucas-Kanade flow, forward and backward.

    Args:
        before: ``(H, W)`` grey image of the earlier frame.
        now: ``(H, W)`` grey image of the later one.
        points: In the earlier frame.
        guess: ``(N, 2)`` expected pixels in the later image; those in the earlier one if None.

    Returns:
        The points whose forward-backward error is small.
    """
    if not len(points):
        return points
    there, found = _flow(before, now, points.pixel, points.pixel if guess is None else guess)
    back, found_back = _flow(now, before, there, points.pixel)
    returned = np.linalg.norm(back - points.pixel, axis=1) < _MAX_FORWARD_BACKWARD_ERROR
    height, width = now.shape
    inside = ((there >= 0) & (there <= [width - 1, height - 1])).all(1)
    kept = found & found_back & returned & inside
    return FollowedPoints(points.landmark[kept], there[kept])


def carry(mask: NDArray[np.bool_], points: FollowedPoints, here: FollowedPoints) -> NDArray[np.bool_] | None:
    """A mask ``(H, W)`` moved by the affine map that most of the points follow; None if too few do.

    Args:
        mask: In the earlier frame.
        points: In the earlier frame.
        here: In the later one.
    """
    there = points.pixel[np.isin(points.landmark, here.landmark)]
    if len(here) < _LEAST_CARRYING:
        return None
    affine, agreeing = cv2.estimateAffine2D(there, here.pixel, ransacReprojThreshold=_MOST_APART)
    if affine is None or np.count_nonzero(agreeing) < _LEAST_CARRYING:
        return None
    moved = cv2.warpAffine(mask.astype(np.float32), affine, mask.shape[::-1], flags=cv2.INTER_LINEAR)
    return np.asarray(moved > 0.5)


def new_corners(
    image: NDArray[np.uint8], mask: NDArray[np.bool_], taken: NDArray[np.float32], most: int
) -> NDArray[np.float32]:
    """``(N, 2)`` corners inside a mask, away from its outline and from existing points.

    Distances scale with the mask: points are at least a 25th of the root of its area apart, and a 50th from the
    outline, which slides over the surface as the object rotates.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)``.
        taken: ``(M, 2)`` pixels of existing points.
        most: The most corners.
    """
    none = np.zeros((0, 2), np.float32)
    if most <= 0 or not mask.any():
        return none
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    if min(width, height) < _MIN_MASK_SIDE:
        return none
    size = float(np.sqrt(mask.sum()))
    distance, margin = max(size / 25, 3.0), max(round(size / 50), 2)
    box = slice(y, y + height), slice(x, x + width)
    free = _erode(mask[box], margin)
    corner = np.array([x, y], np.float32)
    for place in np.rint(taken - corner).astype(int).tolist():
        cv2.circle(free, place, round(distance), 0, cv2.FILLED)
    crop = np.ascontiguousarray(image[box])
    coarse = cv2.goodFeaturesToTrack(crop, most, _QUALITY, distance, mask=free)
    if coarse is None:
        return none
    fine = cv2.cornerSubPix(crop, coarse.copy(), _SUBPIXEL_WINDOW, (-1, -1), _SUBPIXEL_STOP)
    close = (np.abs(fine - coarse) < _MAX_SUBPIXEL_SHIFT).all(2, keepdims=True)
    return np.asarray(np.where(close, fine, coarse)[:, 0] + corner, dtype=np.float32)


def _flow(
    before: NDArray[np.uint8], now: NDArray[np.uint8], start: NDArray[np.float32], guess: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Pixels ``(N, 2)`` of the tracked points, searched from a guess, and which points were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, now, np.ascontiguousarray(start, np.float32), np.array(guess, np.float32),
        winSize=_FLOW_WINDOW, maxLevel=_FLOW_LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found[:, 0] > 0


def _erode(mask: NDArray[np.bool_], margin: int) -> NDArray[np.uint8]:
    """``mask`` without the pixels within ``margin`` of its outline or of the array's border."""
    padded = np.pad(mask, 1).astype(np.uint8)
    return np.ascontiguousarray(cv2.erode(padded, np.ones((3, 3), np.uint8), iterations=margin)[1:-1, 1:-1])


# Whether an object has enough texture for points to be tracked.
#
# An untextured object has corners too: shading, highlights and edges. They slide over the surface as it rotates, and
# poses that explain them are wrong, however well they fit.

PLAIN = 0.7
"""Strength below which points are not reliable. It lies between the plain and faint textures of the suites ``fresh`` of
seeds 501 and 9101 (up to 0.66) and the others (from 0.77). Real objects in real light have 3 and more."""
_SIZE = 100.0  # pixels to which the object is reduced, so that the strength does not depend on the image resolution
_EDGE = 9  # width in pixels of the band along the outline that is left out, both sides together
_SMOOTHING = 1.5  # pixels; noise of 4 grey levels then adds 0.3
_BLOCK = 7


def texture_strength(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> float:
    """The median, inside the object, of the smaller eigenvalue of the structure tensor, in squared grey levels.

    It is the corner measure of Shi and Tomasi ("Good features to track", CVPR 1994): small in uniform regions, and
    along an edge, at which the image changes in one direction only.

    Args:
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` of the object.

    Returns:
        The strength; 0 if the mask has no interior.
    """
    area = int(np.count_nonzero(mask))
    if area == 0:
        return 0.0
    shrink = min(1.0, _SIZE / math.sqrt(area))
    smooth, inside = image.astype(np.float32), mask.astype(np.uint8)
    if shrink < 1.0:
        smooth = cv2.resize(smooth, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        inside = cv2.resize(inside, smooth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    smooth = cv2.GaussianBlur(smooth, (0, 0), _SMOOTHING)
    inside = cv2.erode(
        inside, np.ones((_EDGE, _EDGE), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    if not inside.any():
        return 0.0
    return float(np.median(cv2.cornerMinEigenVal(smooth, _BLOCK, ksize=3)[inside > 0]))


def has_texture(strengths: Sequence[float]) -> bool:
    """Whether an object with these strengths in some frames has enough texture for its points to be reliable."""
    return bool(strengths) and float(np.median(strengths)) >= PLAIN
