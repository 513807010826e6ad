"""VOT overlaps and long-term scores by hand and frame by frame."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tracking3d_bench.evaluation.vot import (
    LongTermSequence,
    confidence_thresholds,
    long_term_curves,
    long_term_scores,
    mask_overlap,
    rectangle_overlap,
)


def drawn(rectangle, size=(40, 30)):
    """A rectangle as the pixels it covers, ``(H, W)``."""
    x, y, width, height = np.round(rectangle)
    column, row = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    return (column >= x) & (column < x + width) & (row >= y) & (row < y + height)


def test_rectangles_by_hand():
    # 6 x 4 pixels are common, of 100 + 100.
    assert rectangle_overlap((0, 0, 10, 10), (4, 6, 10, 10)) == 24 / 176
    assert rectangle_overlap((0, 0, 10, 10), (0, 0, 10, 10)) == 1.0
    assert rectangle_overlap((0, 0, 10, 10), (10, 0, 10, 10)) == 0.0


@pytest.mark.parametrize("seed", range(20))
def test_rectangles_overlap_as_the_pixels_they_cover_in_the_frame(seed):
    random = np.random.default_rng(seed)
    a, b = (np.concatenate([random.uniform(-5, 30, 2), random.uniform(3, 25, 2)]) for _ in range(2))
    assert rectangle_overlap(a, b, (40, 30)) == pytest.approx(mask_overlap(drawn(a), drawn(b)))


def test_rectangles_are_rounded_to_pixels_and_halves_to_the_even_number():
    assert rectangle_overlap((0.4, 0, 10, 10), (0, 0, 10, 10)) == 1.0
    assert rectangle_overlap((0.5, 0, 10, 10), (0, 0, 10, 10)) == 1.0
    assert rectangle_overlap((1.5, 0, 10, 10), (2, 0, 10, 10)) == 1.0


def test_what_lies_outside_the_frame_does_not_count():
    assert rectangle_overlap((-10, 0, 20, 10), (0, 0, 10, 10)) == 0.5
    assert rectangle_overlap((-10, 0, 20, 10), (0, 0, 10, 10), (40, 30)) == 1.0
    assert rectangle_overlap((50, 0, 5, 5), (60, 0, 5, 5), (40, 30)) == 0.0


@pytest.mark.parametrize("empty", [(5, 5, 0, 3), (5, 5, 3, 0.4), (5, 5, -3, 3), (math.nan,) * 4])
def test_two_empty_regions_agree_and_one_empty_region_does_not(empty):
    assert rectangle_overlap(empty, empty) == 1.0
    assert rectangle_overlap(empty, (5, 5, 3, 3)) == rectangle_overlap((5, 5, 3, 3), empty) == 0.0
    nothing = np.zeros((4, 4), bool)
    assert mask_overlap(nothing, nothing) == 1.0
    assert mask_overlap(nothing, ~nothing) == 0.0


def test_few_confidences_are_all_thresholds():
    np.testing.assert_array_equal(confidence_thresholds([0.2, 0.9, 0.5]), [np.inf, 0.9, 0.5, 0.2, -np.inf])


def test_of_many_confidences_as_many_as_asked_are_thresholds_at_even_ranks():
    thresholds = confidence_thresholds(np.arange(1000.0), 12)
    assert len(thresholds) == 12
    # From rank 100 to rank 900 of the falling values 999, 998, ...
    np.testing.assert_array_equal(thresholds[[1, 10]], [899, 99])
    assert (np.diff(thresholds) < 0).all()


def slow_curves(overlaps, confidence, visible, thresholds):
    precision, recall = [], []
    for threshold in thresholds:
        kept = [o for o, c in zip(overlaps, confidence, strict=True) if c >= threshold]
        precision.append(sum(kept) / len(kept) if kept else 1.0)
        recall.append(sum(kept) / sum(visible))
    return precision, recall


@pytest.mark.parametrize("seed", range(5))
def test_curves_are_those_found_frame_by_frame(seed):
    random = np.random.default_rng(seed)
    overlaps, confidence = random.random((2, 50)).round(2)
    visible = random.random(50) < 0.8
    thresholds = confidence_thresholds(confidence, 20)
    expected = slow_curves(overlaps, confidence, visible, thresholds)
    np.testing.assert_allclose(long_term_curves(overlaps, confidence, visible, thresholds), expected)


def test_scores_by_hand():
    # Confident in the two visible frames: precision 0.7, recall 1.4 / 2.
    sequence = LongTermSequence([0.8, 0.6, 0.0], [0.9, 0.8, 0.1], np.array([True, True, False]))
    scores = long_term_scores([sequence])
    assert (scores.precision, scores.recall, scores.f_score) == pytest.approx((0.7, 0.7, 0.7))
    assert scores.threshold == 0.8


def test_without_confidence_the_threshold_keeps_all_frames():
    sequence = LongTermSequence([0.8, 0.6, 0.0], np.zeros(3), np.array([True, True, False]))
    scores = long_term_scores([sequence])
    assert (scores.precision, scores.recall) == pytest.approx((1.4 / 3, 0.7))


def test_a_perfect_tracker_has_full_scores():
    scores = long_term_scores([LongTermSequence(np.ones(9), np.linspace(0, 1, 9), np.ones(9, bool))])
    assert (scores.precision, scores.recall, scores.f_score) == (1.0, 1.0, 1.0)


def test_a_tracker_that_never_overlaps_has_an_f_of_zero():
    scores = long_term_scores([LongTermSequence(np.zeros(9), np.linspace(0, 1, 9), np.ones(9, bool))])
    assert scores.f_score == 0.0


def test_curves_are_averaged_over_sequences_before_the_largest_f_is_taken():
    good = LongTermSequence([1.0, 1.0], [0.9, 0.9], np.ones(2, bool))
    poor = LongTermSequence([0.2, 0.2], [0.1, 0.1], np.ones(2, bool))
    scores = long_term_scores([good, poor])
    # At 0.9 the second is silent: precision (1 + 1) / 2, recall (1 + 0) / 2; at 0.1 both are 0.6.
    assert (scores.precision, scores.recall) == (1.0, 0.5)
    assert scores.f_score == pytest.approx(2 / 3)


def test_without_sequences_there_are_no_scores():
    assert long_term_scores([]) is None


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"\(3, 4\), got \(4, 3\)"):
        mask_overlap(np.ones((3, 4), bool), np.ones((4, 3), bool))
    with pytest.raises(ValueError, match=r"a needs shape \(4\), got \(3,\)"):
        rectangle_overlap((1, 2, 3), (1, 2, 3, 4))
    with pytest.raises(ValueError, match=r"confidence needs shape \(2\), got \(3,\)"):
        long_term_curves([1, 1], [1, 1, 1], np.ones(2, bool), [0])
    with pytest.raises(ValueError, match="not finite"):
        long_term_scores([LongTermSequence([1.0, np.nan], [1, 1], np.ones(2, bool))])
    with pytest.raises(ValueError, match="no frame of 2 shows the object"):
        long_term_scores([LongTermSequence([1.0, 1.0], [1, 1], np.zeros(2, bool))])
