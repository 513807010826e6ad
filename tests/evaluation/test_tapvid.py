"""TAP-Vid scores counted by hand and point by point."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d_bench.evaluation.tapvid import first_queries, strided_queries, tapvid_scores, to_tapvid_raster


def queries(*frames):
    return np.array([[t, 0.0, 0.0] for t in frames])


def still(points, frames):
    """``(N, T, 2)`` tracks that stand still."""
    return np.tile(np.arange(points)[:, None, None] * 10.0, (1, frames, 2))


def random_video(seed, points=7, frames=12):
    random = np.random.default_rng(seed)
    occluded, said = random.random((2, points, frames)) < 0.4
    tracks = random.random((points, frames, 2)) * 256
    estimated = tracks + random.normal(size=tracks.shape) * random.choice([0.5, 3, 20], (points, frames, 1))
    return queries(*random.integers(0, frames, points)), occluded, tracks, said, estimated


def slow_scores(query_points, occluded, tracks, said, estimated, mode):
    """Every point in every frame: occlusion accuracy, Jaccards and shares within the thresholds."""
    right = total = 0
    counts = {threshold: np.zeros(4, int) for threshold in (1, 2, 4, 8, 16)}
    for n, (t, _, _) in enumerate(query_points):
        for frame in range(tracks.shape[1]):
            if frame <= t if mode == "first" else frame == t:
                continue
            total += 1
            right += occluded[n, frame] == said[n, frame]
            distance = np.hypot(*(tracks[n, frame] - estimated[n, frame]))
            for threshold, count in counts.items():
                visible, called, near = not occluded[n, frame], not said[n, frame], distance < threshold
                true_positive = visible and called and near
                count += (visible, true_positive, called and not true_positive, visible and near)
    return (
        right / total,
        [found / (visible + wrong) for visible, found, wrong, _ in counts.values()],
        [near / visible for visible, _, _, near in counts.values()],
    )


@pytest.mark.parametrize("mode", ["first", "strided"])
@pytest.mark.parametrize("seed", range(5))
def test_scores_are_those_found_point_by_point(seed, mode):
    query_points, occluded, tracks, said, estimated = random_video(seed)
    scores = tapvid_scores(query_points, occluded, tracks, said, estimated, mode)
    accuracy, jaccard, within = slow_scores(query_points, occluded, tracks, said, estimated, mode)
    assert scores.occlusion_accuracy == pytest.approx(accuracy)
    assert scores.jaccard == pytest.approx(jaccard)
    assert scores.within == pytest.approx(within)
    assert scores.average_jaccard == pytest.approx(np.mean(jaccard))
    assert scores.average_within == pytest.approx(np.mean(within))


@pytest.mark.parametrize("mode", ["first", "strided"])
def test_a_perfect_tracker_has_full_scores(mode):
    query_points, occluded, tracks, _, _ = random_video(3)
    scores = tapvid_scores(query_points, occluded, tracks, occluded, tracks, mode)
    assert scores.average_jaccard == scores.average_within == scores.occlusion_accuracy == 1.0


@pytest.mark.parametrize(
    ("shift", "right"), [(0.99, 5), (1.0, 4), (1.01, 4), (3.0, 3), (8.0, 1), (15.9, 1), (16.0, 0)]
)
def test_a_known_shift_is_under_the_known_thresholds(shift, right):
    tracks, seen = still(2, 4), np.zeros((2, 4), bool)
    moved = tracks + np.array([shift, 0.0])
    scores = tapvid_scores(queries(0, 0), seen, tracks, seen, moved, "first")
    assert scores.average_within == pytest.approx(right / 5)
    # A visible point that is far off is missed and wrongly claimed.
    assert scores.jaccard == tuple(float(share) for share in scores.within)


def test_a_point_that_is_off_in_half_of_the_frames_counts_twice_in_the_jaccard():
    tracks, seen = still(1, 5), np.zeros((1, 5), bool)
    estimated = tracks.copy()
    estimated[:, 3:] += 100
    scores = tapvid_scores(queries(0), seen, tracks, seen, estimated, "first")
    assert scores.average_within == 0.5
    assert scores.average_jaccard == pytest.approx(2 / (4 + 2))


def test_visibility_does_not_matter_to_the_shares_within():
    tracks, seen = still(3, 5), np.zeros((3, 5), bool)
    scores = tapvid_scores(queries(0, 0, 0), seen, tracks, ~seen, tracks, "first")
    assert scores.average_within == 1.0
    assert scores.average_jaccard == scores.occlusion_accuracy == 0.0


def test_first_scores_the_frames_after_the_query_and_strided_all_others():
    tracks, seen = still(1, 5), np.zeros((1, 5), bool)
    estimated = tracks.copy()
    estimated[0, :2] += 100  # wrong before the query in frame 2
    estimated[0, 2] += 100  # and in it
    assert tapvid_scores(queries(2), seen, tracks, seen, estimated, "first").average_within == 1.0
    assert tapvid_scores(queries(2), seen, tracks, seen, estimated, "strided").average_within == 0.5


def test_a_query_between_frames_belongs_to_the_nearest():
    tracks, seen = still(1, 4), np.zeros((1, 4), bool)
    estimated = tracks.copy()
    estimated[0, 3] += 100
    assert tapvid_scores(queries(2.4), seen, tracks, seen, estimated, "first").average_within == 0.0
    assert tapvid_scores(queries(2.6), seen, tracks, seen, estimated, "first").average_within is None


def test_positions_of_hidden_points_do_not_matter():
    query_points, occluded, tracks, said, estimated = random_video(4)
    unknown = np.where(occluded[..., None], np.nan, tracks)
    assert tapvid_scores(query_points, occluded, unknown, said, estimated, "first") == tapvid_scores(
        query_points, occluded, tracks, said, estimated, "first"
    )


@pytest.mark.parametrize("nothing", [np.nan, np.inf])
def test_an_estimate_without_a_position_is_wrong(nothing):
    tracks, seen = still(1, 3), np.zeros((1, 3), bool)
    scores = tapvid_scores(queries(0), seen, tracks, seen, np.full_like(tracks, nothing), "first")
    assert scores.average_within == scores.average_jaccard == 0.0


def test_where_nothing_is_visible_there_is_no_share_within():
    tracks, hidden = still(1, 3), np.ones((1, 3), bool)
    quiet = tapvid_scores(queries(0), hidden, tracks, hidden, tracks, "first")
    assert (quiet.average_within, quiet.average_jaccard, quiet.occlusion_accuracy) == (None, None, 1.0)
    claimed = tapvid_scores(queries(0), hidden, tracks, ~hidden, tracks, "first")
    assert (claimed.average_within, claimed.average_jaccard, claimed.occlusion_accuracy) == (None, 0.0, 0.0)


def test_without_scored_frames_there_is_no_score():
    tracks, seen = still(2, 3), np.zeros((2, 3), bool)
    late = tapvid_scores(queries(2, 2), seen, tracks, seen, tracks, "first")
    none = tapvid_scores(np.empty((0, 3)), seen[:0], tracks[:0], seen[:0], tracks[:0], "strided")
    for scores in (late, none):
        assert (scores.average_within, scores.average_jaccard, scores.occlusion_accuracy) == (
            None,
            None,
            None,
        )
        assert scores.within == (None,) * 5


def test_the_raster_has_its_origin_in_the_corner_of_the_frame():
    corners = np.array([[-0.5, -0.5], [639.5, 479.5], [319.5, 239.5]])
    np.testing.assert_allclose(to_tapvid_raster(corners, (640, 480)), [[0, 0], [256, 256], [128, 128]])


def test_first_queries_are_where_a_point_is_first_seen():
    occluded = np.array([[1, 0, 0], [1, 1, 1], [0, 1, 0]], bool)
    tracks = np.arange(18, dtype=float).reshape(3, 3, 2)
    query_points, point = first_queries(occluded, tracks)
    np.testing.assert_array_equal(point, [0, 2])
    np.testing.assert_array_equal(query_points, [[1, 3, 2], [0, 13, 12]])


def test_strided_queries_are_the_points_seen_in_every_fifth_frame():
    occluded = np.zeros((2, 11), bool)
    occluded[0, 5] = True
    tracks = np.arange(44, dtype=float).reshape(2, 11, 2)
    query_points, point = strided_queries(occluded, tracks)
    np.testing.assert_array_equal(point, [0, 1, 1, 0, 1])
    np.testing.assert_array_equal(query_points[:, 0], [0, 0, 5, 10, 10])
    np.testing.assert_array_equal(query_points[2, 1:], tracks[1, 5, ::-1])


def test_what_does_not_fit_is_refused():
    tracks, seen = still(2, 4), np.zeros((2, 4), bool)
    good = {
        "query_points": queries(0, 0),
        "gt_occluded": seen,
        "gt_tracks": tracks,
        "pred_occluded": seen,
        "pred_tracks": tracks,
        "query_mode": "first",
    }
    for name, value, reason in (
        ("query_points", queries(0), r"\(2, 3\), got \(1, 3\)"),
        ("query_points", queries(0, 4), "frames 0 to 4, of 4 frames"),
        ("query_points", queries(0, -1), "frames -1 to 0"),
        ("query_points", queries(0, np.nan), "not finite"),
        ("gt_tracks", tracks[:, :3], r"gt_tracks needs shape \(2, 4, 2\), got \(2, 3, 2\)"),
        ("pred_tracks", tracks[:1], r"pred_tracks needs shape \(2, 4, 2\), got \(1, 4, 2\)"),
        ("pred_occluded", seen.T, r"pred_occluded needs shape \(2, 4\), got \(4, 2\)"),
        ("gt_occluded", seen.astype(float), "gt_occluded needs bool, got float64"),
        ("query_mode", "last", "no query mode 'last'"),
    ):
        with pytest.raises(ValueError, match=reason):
            tapvid_scores(**(good | {name: value}))
    with pytest.raises(ValueError, match=r"\(\.\.\., 2\), got \(4, 3\)"):
        to_tapvid_raster(np.ones((4, 3)), (10, 10))
