"""Calibration and detection counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tracking3d_bench.evaluation.calibration import (
    Detection,
    detection_scores,
    expected_calibration_error,
    reliability,
)


def slow_error(confidence, right, bins=10):
    """Guo's sum over the bins ((m - 1) / M, m / M], the first with 0."""
    total = 0.0
    for m in range(bins):
        inside = (confidence > m / bins) & (confidence <= (m + 1) / bins) | ((m == 0) & (confidence == 0))
        if inside.any():
            total += inside.mean() * abs(right[inside].mean() - confidence[inside].mean())
    return total


@pytest.mark.parametrize("seed", range(5))
def test_the_error_is_the_one_summed_bin_by_bin(seed):
    random = np.random.default_rng(seed)
    confidence, right = random.random(200), random.random(200) < 0.6
    assert expected_calibration_error(confidence, right) == pytest.approx(slow_error(confidence, right))


def test_who_is_as_often_right_as_confident_has_no_error():
    confidence = np.repeat([0.25, 0.75], 4)
    right = np.array([1, 0, 0, 0, 1, 1, 1, 0], bool)
    assert expected_calibration_error(confidence, right) == 0.0


def test_who_is_always_sure_and_never_right_has_the_largest_error():
    assert expected_calibration_error(np.ones(5), np.zeros(5, bool)) == 1.0


def test_a_case_by_hand():
    # 0.9 and 1.0 lie in different bins: 3/5 |2/3 - 0.9| + 2/5 |0 - 1|.
    confidence, right = [0.9, 0.9, 0.9, 1.0, 1.0], np.array([1, 1, 0, 0, 0], bool)
    assert expected_calibration_error(confidence, right) == pytest.approx(0.6 * (0.9 - 2 / 3) + 0.4)


def test_over_and_under_confidence_in_one_bin_cancel():
    assert expected_calibration_error([0.41, 0.49], [True, False]) == pytest.approx(0.05)
    assert expected_calibration_error([0.41, 0.49], [True, False], bins=100) == pytest.approx(
        (0.59 + 0.49) / 2
    )


@pytest.mark.parametrize(
    ("confidence", "expected"), [(0.0, 0), (0.1, 0), (0.3, 2), (0.7, 6), (0.701, 7), (1, 9)]
)
def test_a_bin_holds_its_upper_edge_and_the_first_holds_zero(confidence, expected):
    count = reliability([confidence], [True]).count
    assert np.flatnonzero(count) == [expected]


def test_the_diagram_has_a_mean_and_a_share_where_a_bin_is_not_empty():
    found = reliability([0.1, 0.2, 0.9], [False, True, True], bins=2)
    np.testing.assert_array_equal(found.edges, [0, 0.5, 1])
    np.testing.assert_array_equal(found.count, [2, 1])
    np.testing.assert_allclose(found.confidence, [0.15, 0.9])
    np.testing.assert_allclose(found.accuracy, [0.5, 1])
    assert np.isnan(reliability([0.1], [True], bins=2).accuracy[1])


def test_without_answers_there_is_no_error():
    assert expected_calibration_error([], np.empty(0, bool)) is None


def test_lost_frames_by_hand():
    called = np.array([1, 1, 1, 0, 0, 0], bool)
    actual = np.array([1, 1, 0, 1, 0, 0], bool)
    assert detection_scores(called, actual) == Detection(2 / 3, 2 / 3, 2 / 3)
    assert detection_scores(called, called) == Detection(1.0, 1.0, 1.0)


def test_what_cannot_be_said_is_none():
    some, none = np.array([True, False]), np.zeros(2, bool)
    assert detection_scores(none, none) == Detection(None, None, None)
    assert detection_scores(some, none) == Detection(0.0, None, 0.0)
    assert detection_scores(none, some) == Detection(None, 0.0, 0.0)
    assert detection_scores(none[:0], none[:0]) == Detection(None, None, None)


def test_f1_is_the_harmonic_mean():
    random = np.random.default_rng(0)
    called, actual = random.random((2, 100)) < 0.5
    scores = detection_scores(called, actual)
    assert scores.f1 == pytest.approx(2 / (1 / scores.precision + 1 / scores.recall))


@pytest.mark.parametrize("confidence", [[1.1, 0.2], [-0.1, 0.2], [np.nan, 0.2]])
def test_confidence_outside_its_range_is_refused(confidence):
    with pytest.raises(ValueError, match=r"in \[0, 1\]|not finite"):
        expected_calibration_error(confidence, [True, False])


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"right needs shape \(2\), got \(3,\)"):
        expected_calibration_error([0.1, 0.2], [True, False, True])
    with pytest.raises(ValueError, match="right needs bool, got int64"):
        expected_calibration_error([0.1, 0.2], np.array([1, 0]))
    with pytest.raises(ValueError, match=r"called needs shape \(2\), got \(1,\)"):
        detection_scores([True], [True, False])
