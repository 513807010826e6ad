"""Tracks points in the images alone, if no surface predicts their motion.

Pyramidal Lucas-Kanade (Bouguet, "Pyramidal implementation of the affine Lucas Kanade feature tracker", 2001) from the
frame before, from the last frame whose appearance still fits, and from the frame of the question; each answer has to
find its way back and to look like its template, and their mean by variance counts. So drift adds up only while the
appearance changes. A point that is not found goes along with what is around it, and is looked for there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d.points.pictures import Grey, Picture, contrast, likeness, patches, placement_variance
from tracking3d.runtime.progress import report_each
from tracking3d.scene.view import Array

_WINDOW = (17, 17)
_LEVELS = 4  # halvings of the picture
_ENDS = (3, 30, 0.01)  # after so many steps, or below so many pixels
_LEAST_TEXTURE = 1e-5
_BACK = 1.0  # pixels by which the way back may miss
_LIKE = 0.7  # likeness of neighbouring frames
_KEPT = 0.8  # likeness to a template of long ago
_FOUND = 0.85  # likeness by which a lost point is found, or one that lies where its layer is not
_TOGETHER = 2.0  # pixels by which a template of long ago may contradict the way from frame to frame
_TELLS = 4.0  # contrast from which a patch looks like something
_NOISE = 3.0  # deviation of grey values that say the same
_CORRELATED = 6.0  # pixels of a patch that say the same, since what moves them off moves their neighbours too
_FLOOR = 0.04  # pixels: of interpolation
_RIM = 3.0  # pixels by which masks may be off
_AROUND = 9  # helpers that a hidden point goes along with
_HELPERS = 400
_MOST_KEPT = 32  # pictures that templates are kept of


@dataclass(frozen=True, eq=False)
class ImageTracks:
    """N points in T pictures."""

    # (T, N, 2) pixels; where a point is not found, where it would be by what is around it. NaN where there is
    # no picture.
    positions: Array
    visible: NDArray[np.bool_]  # (T, N) bool: whether it was found
    uncertainty: Array  # (T, N) pixels within twice which a position is right in some 19 of 20 cases
    likeness: Array  # (T, N) correlation with the best template; -1 where none was found
    variance: Array  # (T, N) squared pixels: those of all placements on the way there added up


@dataclass(eq=False)
class _Template:
    """What N points looked like: rows of pictures ``(N,)``, pixels ``(N, 2)`` there and their variances ``(N,)``."""

    row: NDArray[np.int64]
    xy: Array
    variance: Array

    def replace_where(self, chosen: NDArray[np.bool_], row: int, xy: Array, variance: Array) -> _Template:
        return _Template(
            np.where(chosen, row, self.row),
            np.where(chosen[:, None], xy, self.xy),
            np.where(chosen, variance, self.variance),
        )


@dataclass(frozen=True, eq=False)
class ImageAnswers:
    """N points in one picture; see `ImageTracks`."""

    positions: Array
    visible: NDArray[np.bool_]
    uncertainty: Array
    likeness: Array
    variance: Array


class ImageFollower:
    """Follows pixels of one picture through those that come after it, or before it.

    Args:
        index: The index of the picture.
        picture: The one that the pixels are in.
        xy: ``(N, 2)`` pixels.
    """

    def __init__(self, index: int, picture: Picture, xy: Array) -> None:
        self.xy = xy
        self._on_object = picture.depth_in_mask(xy) > 0
        self._asked = _Template(np.full(len(xy), index), xy, np.zeros(len(xy)))
        self._first, self._pictures = index, {index: picture}
        self._begin()

    def _begin(self) -> None:
        count = len(self.xy)
        self._kept, self._last = self._asked, self._first
        self._position, self._variance, self._hidden = self.xy.copy(), np.zeros(count), np.zeros(count)

    def first(self) -> ImageAnswers:
        """The answer for the picture that the pixels are in."""
        count = len(self.xy)
        nothing = np.zeros(count)
        error = expected_image_error(nothing, 0, 0)
        return ImageAnswers(self.xy, np.ones(count, bool), error, np.ones(count), nothing)

    def step(self, index: int, now: Picture) -> ImageAnswers:
        """Answer for the next picture; on the other side of the first one it begins there again.

        Args:
            index: The index of the picture.
            now: The picture.
        """
        if (index - self._first) * (self._last - self._first) < 0:
            self._begin()
        last, position, variance = self._last, self._position, self._variance
        before, seen = self._pictures[last], self._hidden == 0
        self._pictures[index] = now
        ahead = _predict_position(before, now, position, seen, self._on_object)
        step = _place_point(
            self._pictures,
            index,
            _Template(np.full(len(ahead), last), position, variance),
            ahead,
            seen,
            _LIKE,
        )
        guess = np.where(np.isfinite(step.variance)[:, None], step.xy, ahead)
        lost = ~np.isfinite(step.variance)
        total, weight, alike = _mean_begun(step)
        same = self._kept.row == self._asked.row
        for template, asked in ((self._kept, ~same), (self._asked, np.ones(len(same), bool))):
            found = _place_point(
                self._pictures,
                index,
                template,
                guess,
                asked & (template.row != last),
                np.where(lost, _FOUND, _KEPT),
            )
            contradicts = ~lost & (np.linalg.norm(found.xy - step.xy, axis=1) > _TOGETHER)
            _add(found, ~contradicts, total, weight, alike)
        # Where its layer is not, a point needs more than a way from the frame before.
        at = np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-12)[:, None], ahead)
        depth = now.depth_in_mask(at)
        elsewhere = np.where(self._on_object, depth < -_RIM, depth > _RIM)
        is_found = (weight > 0) & now.holds(at) & ~(elsewhere & (alike < _FOUND))
        # The template that was kept no longer says anything: the frame before is the next one.
        stale = is_found & ~lost & (1 / np.maximum(weight, 1e-12) >= step.variance * 0.999)
        self._kept = self._kept.replace_where(stale, last, position, variance)
        moved = np.linalg.norm(ahead - position, axis=1)
        self._position = np.where(is_found[:, None], at, ahead)
        self._variance = np.where(
            is_found, 1 / np.maximum(weight, 1e-12), variance + (0.3 + 0.2 * moved) ** 2
        )
        self._hidden = np.where(is_found, 0, self._hidden + 1)
        self._last = index
        self._forget()
        return ImageAnswers(
            self._position,
            is_found,
            expected_image_error(self._variance, abs(index - self._first), self._hidden),
            np.where(is_found, alike, -1.0),
            self._variance,
        )

    def _forget(self) -> None:
        """Keep the pictures that a template is of; of too many of them the oldest is left for that of the question."""
        rows = sorted(
            set(self._kept.row.tolist()) - {self._first, self._last}, key=lambda row: abs(row - self._last)
        )
        dropped = np.isin(self._kept.row, rows[_MOST_KEPT:])
        self._kept = self._kept.replace_where(dropped, self._first, self.xy, np.zeros(len(self.xy)))
        held = {self._first, self._last, *rows[:_MOST_KEPT]}
        self._pictures = {row: picture for row, picture in self._pictures.items() if row in held}


def follow_in_images(pictures: Sequence[Picture | None], start: int, xy: Array) -> ImageTracks:
    """Follow pixels of one picture through all of them, forwards and backwards.

    Args:
        pictures: T frames; None if there is none.
        start: Index of the one that the pixels are in.
        xy: ``(N, 2)`` pixels.
    """
    whole, count = len(pictures), len(xy)
    tracks = ImageTracks(
        np.full((whole, count, 2), np.nan),
        np.zeros((whole, count), bool),
        np.full((whole, count), np.nan),
        np.full((whole, count), -1.0),
        np.full((whole, count), np.nan),
    )
    first = pictures[start]
    if first is None or not count:
        return tracks
    follower = ImageFollower(start, first, xy)
    _write(tracks, start, follower.first())
    for row in report_each("following points", (*range(start + 1, whole), *range(start - 1, -1, -1))):
        if (picture := pictures[row]) is not None:
            _write(tracks, row, follower.step(row, picture))
    return tracks


def _write(tracks: ImageTracks, row: int, estimates: ImageAnswers) -> None:
    for name in ("positions", "visible", "uncertainty", "likeness", "variance"):
        getattr(tracks, name)[row] = getattr(estimates, name)


@dataclass(frozen=True, eq=False)
class _Placed:
    """Where templates lie in a picture: pixels ``(N, 2)``, variances ``(N,)``, infinite if they are not found, and
    likeness ``(N,)``."""

    xy: Array
    variance: Array
    likeness: Array


def _place_point(
    pictures: Mapping[int, Picture],
    row: int,
    template: _Template,
    guess: Array,
    asked: NDArray[np.bool_],
    least: float | Array,
) -> _Placed:
    """Look for templates in picture ``row`` near ``guess`` ``(N, 2)``; ``least`` is the likeness that is asked for."""
    count = len(guess)
    found = _Placed(guess.copy(), np.full(count, np.inf), np.full(count, -1.0))
    least = np.broadcast_to(np.asarray(least, float), (count,))
    now = pictures[row]
    asked = asked & now.holds(guess)
    for source in np.unique(template.row[asked]).tolist():
        picture = pictures[source]
        chosen = np.flatnonzero(asked & (template.row == source))
        from_xy = template.xy[chosen]
        there, good = _flow(picture.grey, now.grey, from_xy, guess[chosen])
        back, returned = _flow(now.grey, picture.grey, there, from_xy)
        with np.errstate(invalid="ignore"):
            good &= returned & (np.linalg.norm(back - from_xy, axis=1) < _BACK) & now.holds(there)
        old, new = patches(picture.grey, from_xy), patches(now.grey, there)
        alike = np.where(contrast(old) > _TELLS, likeness(old, new), 1.0)
        good &= alike > least[chosen]
        variance = _CORRELATED * placement_variance(old, new, _NOISE) + _FLOOR**2 + template.variance[chosen]
        found.xy[chosen[good]] = there[good]
        found.variance[chosen[good]], found.likeness[chosen[good]] = variance[good], alike[good]
    return found


def _flow(a: Grey, b: Grey, xy: Array, guess: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Where ``xy`` ``(N, 2)`` of ``a`` lie in ``b``, and which were found."""
    at = guess.astype(np.float32)[:, None].copy()
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        a, b, xy.astype(np.float32)[:, None], at, winSize=_WINDOW, maxLevel=_LEVELS, criteria=_ENDS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW, minEigThreshold=_LEAST_TEXTURE,
    )  # fmt: skip
    return moved[:, 0].astype(np.float64), found[:, 0] > 0


def _mean_begun(step: _Placed) -> tuple[Array, Array, Array]:
    """Sum of positions by weight, the weights, and the best likeness."""
    weight = np.where(np.isfinite(step.variance), 1 / step.variance, 0.0)
    return weight[:, None] * step.xy, weight, step.likeness.copy()


def _add(found: _Placed, counts: NDArray[np.bool_], total: Array, weight: Array, alike: Array) -> None:
    share = np.where(counts & np.isfinite(found.variance), 1 / found.variance, 0.0)
    total += share[:, None] * found.xy
    weight += share
    np.maximum(alike, np.where(counts, found.likeness, -1.0), out=alike)


def _predict_position(
    before: Picture, now: Picture, position: Array, seen: NDArray[np.bool_], on_object: NDArray[np.bool_]
) -> Array:
    """Where points ``(N, 2)`` of the picture before would be; hidden ones go along with corners of their layer."""
    ahead = position.copy()
    if seen.all():
        return ahead
    corners = cv2.goodFeaturesToTrack(before.grey, _HELPERS, 0.01, 7)
    if corners is None:
        return ahead
    at = corners[:, 0].astype(np.float64)
    there, good = _flow(before.grey, now.grey, at, at)
    back, returned = _flow(now.grey, before.grey, there, there)
    good &= returned & (np.linalg.norm(back - at, axis=1) < _BACK)
    depth = before.depth_in_mask(at)
    for layer in (False, True):
        points = np.flatnonzero(~seen & (on_object == layer))
        helpers = np.flatnonzero(good & ((depth > _RIM) if layer else (depth < -_RIM)))
        if not len(points) or len(helpers) < _AROUND:
            continue
        apart = np.linalg.norm(position[points, None] - at[None, helpers], axis=2)
        nearest = helpers[np.argpartition(apart, _AROUND - 1, axis=1)[:, :_AROUND]]
        ahead[points] += np.median(there[nearest] - at[nearest], axis=1)
    return ahead


# Predicts the error in pixels of a point that is tracked by the images alone.
#
# As in `tracking3d.points.follow`: the logarithm of the error is a sum of logarithms; ``training/
# image_point_uncertainty.py`` fitted the weights on clips of some seeds and tested them on those of others.

FOUND = (1.969, 0.939, 0.692, 0.0)
NOT_FOUND = (0.776, 0.288, 0.27, 0.342)
"""Weights of `image_error_features`, of points that were found in a frame and of those that were not."""
_MOST = 3.5  # logarithm of the pixels beyond which nothing is known at all


def image_error_features(variance: ArrayLike, gap: ArrayLike, hidden: ArrayLike) -> Array:
    """``(..., 4)``: one, and logarithms of what makes points be known badly.

    Args:
        variance: Squared pixels of all placements on the way from the question.
        gap: Frames from there.
        hidden: Frames since the point was last found.
    """
    parts = np.broadcast_arrays(
        1.0, np.log(np.asarray(variance) + 1e-2), np.log1p(np.asarray(gap)), np.log1p(np.asarray(hidden))
    )
    return np.stack(parts, -1)


def expected_image_error(variance: ArrayLike, gap: ArrayLike, hidden: ArrayLike) -> Array:
    """Pixels: twice as much holds some 19 of 20 errors; arguments as of `image_error_features`."""
    known = image_error_features(variance, gap, hidden)
    logarithm = np.where(np.asarray(hidden) > 0, known @ np.array(NOT_FOUND), known @ np.array(FOUND))
    error: Array = np.exp(np.clip(logarithm, -3.0, _MOST))
    return error
