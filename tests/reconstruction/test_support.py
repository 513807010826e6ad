"""How far a refined answer is believed, by what is rendered and by landmarks."""

from __future__ import annotations

import pytest

from tracking3d.estimation.estimate import Assessment, Status
from tracking3d.frames import TRACKED_CONFIDENCE
from tracking3d.points.landmark_adjustment import LandmarkSupport
from tracking3d.reconstruction.confidence import judge_with_landmarks, refined_confidence_features

TRACKED = Assessment(Status.TRACKED, "", 0.95)
DOUBTED = Assessment(Status.UNCERTAIN, "points agree, pixels do not", 0.6)


def test_the_more_of_the_landmarks_agree_the_more_an_answer_is_believed():
    for before in (TRACKED, DOUBTED):
        said = [
            judge_with_landmarks(before, LandmarkSupport(300, count)).confidence
            for count in (150, 180, 200, 220)
        ]
        assert said == sorted(set(said))
    barely = Assessment(Status.TRACKED, "", 0.81)
    assert (
        judge_with_landmarks(barely, LandmarkSupport(300, 150)).confidence
        < TRACKED_CONFIDENCE
        < judge_with_landmarks(barely, LandmarkSupport(300, 290)).confidence
    )


@pytest.mark.parametrize("before", [0.1, 0.5, 0.79, 0.81, 0.99])
def test_landmarks_never_raise_a_confidence(before):
    """They have made the pose that they agree with: those of a wrong map agree with each other too."""
    rendering = Assessment(
        Status.TRACKED if before >= TRACKED_CONFIDENCE else Status.UNCERTAIN, "doubted", before
    )
    for agreeing in range(0, 400, 40):
        assert judge_with_landmarks(rendering, LandmarkSupport(400, agreeing)).confidence <= before


def test_few_that_agree_say_less_than_many():
    assert (
        judge_with_landmarks(TRACKED, LandmarkSupport(3, 3)).confidence
        < judge_with_landmarks(TRACKED, LandmarkSupport(90, 90)).confidence
    )


def test_beyond_thirty_more_of_them_add_nothing():
    said = [judge_with_landmarks(TRACKED, LandmarkSupport(count, count)).confidence for count in (200, 400)]
    assert said[0] == said[1]


def test_what_was_believed_before_counts_too():
    support = LandmarkSupport(200, 120)
    assert (
        judge_with_landmarks(DOUBTED, support).confidence <= judge_with_landmarks(TRACKED, support).confidence
    )


def test_a_frame_is_tracked_from_the_confidence_on_at_which_it_is_believed():
    for agreeing in range(0, 400, 10):
        for before in (TRACKED, DOUBTED):
            after = judge_with_landmarks(before, LandmarkSupport(400, agreeing))
            assert (after.status is Status.TRACKED) is (after.confidence >= TRACKED_CONFIDENCE)
            assert (after.reason == "") is (after.status is Status.TRACKED)


def test_doubt_says_why():
    barely = Assessment(Status.TRACKED, "", 0.81)
    assert "(0 of 40 matched landmarks" in judge_with_landmarks(barely, LandmarkSupport(40, 0)).reason
    assert judge_with_landmarks(DOUBTED, LandmarkSupport(40, 0)).reason == DOUBTED.reason


def test_what_is_lost_stays_lost():
    lost = Assessment(Status.LOST, "out of sight", 0.05)
    assert judge_with_landmarks(lost, LandmarkSupport(300, 300)) is lost


@pytest.mark.parametrize("before", [0.0, 1.0])
def test_certainty_and_nothing_followed_are_numbers(before):
    assert all(
        abs(value) < 10 for value in refined_confidence_features(before, LandmarkSupport(0, 0)).values()
    )
