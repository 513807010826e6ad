"""TAP-Vid: metrics of point tracking.

As ``compute_tapvid_metrics`` of ``tapnet`` computes them (Doersch et al., "TAP-Vid: a benchmark for tracking any point
in a video", NeurIPS 2022): N queries in a video of T frames, positions x and y at 256 x 256 pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tracking3d_bench.evaluation.arrays import booleans, finite, floats

THRESHOLDS = (1, 2, 4, 8, 16)
"""Distances in raster pixels below which a point is right."""

RASTER = 256
"""Width and height that all videos are scaled to."""

QueryMode = Literal["first", "strided"]
"""``first``: a point is asked for where it is first seen and scored in the frames after. ``strided``: it is asked for
in every fifth frame that sees it and scored in all frames but that one."""


@dataclass(frozen=True)
class PointScores:
    """Figures of one video; those of a data set are the means over its videos.

    A share of nothing is None (NaN in ``tapnet``): if no point is visible in a scored frame, or no frame is scored.

    Attributes:
        average_jaccard: AJ, the mean of `jaccard`.
        average_within: Delta average, the mean of `within`.
        occlusion_accuracy: OA, share of the scored frames of all points where the visibility is right.
        jaccard: By threshold: visible points found within it, over all that are visible or wrongly said to be.
        within: By threshold: share of the visible points within it, whatever visibility was said.
    """

    average_jaccard: float | None
    average_within: float | None
    occlusion_accuracy: float | None
    jaccard: tuple[float | None, ...]
    within: tuple[float | None, ...]


def tapvid_scores(
    query_points: ArrayLike,
    gt_occluded: ArrayLike,
    gt_tracks: ArrayLike,
    pred_occluded: ArrayLike,
    pred_tracks: ArrayLike,
    query_mode: QueryMode,
) -> PointScores:
    """Score the tracks of one video.

    Args:
        query_points: ``(N, 3)`` t, y and x; only t matters here.
        gt_occluded: ``(N, T)`` bool.
        gt_tracks: ``(N, T, 2)`` x and y in the raster, see `to_tapvid_raster`. May be NaN where occluded.
        pred_occluded: ``(N, T)`` bool.
        pred_tracks: ``(N, T, 2)``; NaN is beyond every threshold.
        query_mode: See `QueryMode`.

    Raises:
        ValueError: If a shape does not fit, a query is outside the video, or there is no such mode.
    """
    occluded = booleans("gt_occluded", gt_occluded, None, None)
    points, frames = occluded.shape
    said_occluded = booleans("pred_occluded", pred_occluded, points, frames)
    true, estimated = (
        floats(name, tracks, points, frames, 2)
        for name, tracks in (("gt_tracks", gt_tracks), ("pred_tracks", pred_tracks))
    )
    scored = _scored_frames(finite("query_points", query_points, points, 3), frames, query_mode)
    visible, said_visible = ~occluded & scored, ~said_occluded & scored
    with np.errstate(invalid="ignore", over="ignore"):
        squared = np.square(estimated - true).sum(2)
    jaccard, within = [], []
    for threshold in THRESHOLDS:
        near = visible & (squared < threshold**2)
        wrong = said_visible & ~near
        jaccard.append(_ratio(near & said_visible, _count(visible) + _count(wrong)))
        within.append(_ratio(near, _count(visible)))
    return PointScores(
        average_jaccard=_mean(jaccard),
        average_within=_mean(within),
        occlusion_accuracy=_ratio((occluded == said_occluded) & scored, _count(scored)),
        jaccard=tuple(jaccard),
        within=tuple(within),
    )


def to_tapvid_raster(points: ArrayLike, size: tuple[int, int]) -> NDArray[np.float64]:
    """Pixels of a frame as coordinates of TAP-Vid's raster.

    Here (0, 0) is the centre of the top-left pixel; in TAP-Vid it is that pixel's outer corner, and the frame's far
    corner is (256, 256).

    Args:
        points: ``(..., 2)`` x and y.
        size: Width and height of the frame.

    Raises:
        ValueError: If the points have not two coordinates.
    """
    xy = np.asarray(points, dtype=np.float64)
    if xy.shape[-1:] != (2,):
        raise ValueError(f"points need shape (..., 2), got {xy.shape}")
    return (xy + 0.5) * (RASTER / np.array(size, dtype=np.float64))


def first_queries(occluded: ArrayLike, tracks: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Where each point is first visible: queries ``(Q, 3)`` t, y, x and whose they are ``(Q,)``.

    A point that is never visible has none.

    Args:
        occluded: ``(N, T)`` bool.
        tracks: ``(N, T, 2)`` x and y.

    Raises:
        ValueError: If a shape does not fit.
    """
    visible, xy = _visible_and_tracks(occluded, tracks)
    point = np.flatnonzero(visible.any(1))
    return _queries(point, visible[point].argmax(1), xy), point


def strided_queries(
    occluded: ArrayLike, tracks: ArrayLike, stride: int = 5
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The points visible in every ``stride``-th frame, as `first_queries` returns them, frame by frame.

    Raises:
        ValueError: If a shape does not fit.
    """
    visible, xy = _visible_and_tracks(occluded, tracks)
    step, point = np.nonzero(visible[:, ::stride].T)
    return _queries(point, step * stride, xy), point


def _visible_and_tracks(
    occluded: ArrayLike, tracks: ArrayLike
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    visible = ~booleans("occluded", occluded, None, None)
    return visible, floats("tracks", tracks, *visible.shape, 2)


def _queries(
    point: NDArray[np.int64], frame: NDArray[np.int64], tracks: NDArray[np.float64]
) -> NDArray[np.float64]:
    x, y = tracks[point, frame].T
    return np.stack([frame.astype(np.float64), y, x], axis=1)


def _scored_frames(
    query_points: NDArray[np.float64], frames: int, query_mode: QueryMode
) -> NDArray[np.bool_]:
    """``(N, T)`` which frames count for which point."""
    asked = np.round(query_points[:, :1]).astype(int)
    if ((asked < 0) | (asked >= frames)).any():
        raise ValueError(f"queries are in frames {asked.min()} to {asked.max()}, of {frames} frames")
    if query_mode == "first":
        return np.arange(frames) > asked
    if query_mode == "strided":
        return np.arange(frames) != asked
    raise ValueError(f"there is no query mode '{query_mode}'; choose first or strided")


def _ratio(part: NDArray[np.bool_], whole: int) -> float | None:
    return _count(part) / whole if whole else None


def _count(mask: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(mask))


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None
