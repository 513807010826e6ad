"""Scores of point correspondences with TAP-Vid's metrics."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tracking3d.video.image_file import read_image
from tracking3d_bench.datasets.answers import Answers, PointTracker
from tracking3d_bench.datasets.truth import Truth
from tracking3d_bench.evaluation.tapvid import PointScores, first_queries, tapvid_scores, to_tapvid_raster


@dataclass(frozen=True, kw_only=True)
class PointTrackScores:
    """Points asked for where each is first seen (TAP-Vid's query mode ``first``) and followed from there.

    All are None if no true points are known or the method follows none, and of an object with an axis of symmetry:
    nothing in the images tells its points around the axis from each other.

    Attributes:
        points_average_jaccard: AJ over 1, 2, 4, 8 and 16 pixels of a 256 x 256 raster.
        points_delta_average: Share of visible points within these distances, averaged.
        points_occlusion_accuracy: Share of visibilities that are right.
        points: Number of points that were asked for.
        points_corrected_average_jaccard: AJ of the points that the images correct, of a run whose landmarks were found;
            the three above are of mesh and poses alone.
        points_corrected_delta_average: Their share within these distances.
        points_corrected_occlusion_accuracy: Their share of visibilities that are right.
    """

    points_average_jaccard: float | None = None
    points_delta_average: float | None = None
    points_occlusion_accuracy: float | None = None
    points: int = 0
    points_corrected_average_jaccard: float | None = None
    points_corrected_delta_average: float | None = None
    points_corrected_occlusion_accuracy: float | None = None


def score_points(answers: Answers, truth: Truth) -> PointTrackScores:
    """Ask the method for every true point where it is first seen, and score what it says after that."""
    by_mesh, corrected = (_score_track(one, truth) for one in (answers.points, answers.corrected_points))
    if by_mesh is None:
        return PointTrackScores()
    scores, points = by_mesh
    found = PointTrackScores(
        points_average_jaccard=scores.average_jaccard,
        points_delta_average=scores.average_within,
        points_occlusion_accuracy=scores.occlusion_accuracy,
        points=points,
    )
    if corrected is None:
        return found
    scores, _ = corrected
    return replace(
        found,
        points_corrected_average_jaccard=scores.average_jaccard,
        points_corrected_delta_average=scores.average_within,
        points_corrected_occlusion_accuracy=scores.occlusion_accuracy,
    )


def _score_track(tracker: PointTracker | None, truth: Truth) -> tuple[PointScores, int] | None:
    """Scores of all true points, and how many these are; None if there are none or the method does not track points."""
    if truth.points is None or tracker is None or truth.symmetry_axis is not None:
        return None
    tracks, occluded = truth.points.positions.transpose(1, 0, 2), ~truth.points.visible.T
    queries, point = first_queries(occluded, tracks)
    if not len(queries):
        return None
    found = np.full((len(queries), *tracks.shape[1:]), np.nan)
    seen = np.zeros((len(queries), tracks.shape[1]), bool)
    for frame in np.unique(queries[:, 0]):
        here = queries[:, 0] == frame
        positions, visible = tracker(int(frame), queries[here, :0:-1])
        found[here], seen[here] = positions.transpose(1, 0, 2), visible.T
    height, width = read_image(truth.frames[0]).shape[:2]
    scores = tapvid_scores(
        queries,
        occluded[point],
        to_tapvid_raster(tracks[point], (width, height)),
        ~seen,
        to_tapvid_raster(found, (width, height)),
        "first",
    )
    return scores, len(queries)
