"""The estimator's judgement of one frame."""

from __future__ import annotations

import pytest

from tracking3d.estimation.estimate import Assessment, Status, assess


def judged(
    appearance: float = 0.1, silhouette: float = 0.1, has_mask: bool = True, failure: str = ""
) -> Assessment:
    return assess(appearance, silhouette, has_mask, tau=0.2, silhouette_limit=0.3, failure=failure)


def test_an_explained_frame_that_agrees_with_its_mask_is_tracked():
    estimate = judged()
    assert (estimate.status, estimate.reason) == (Status.TRACKED, "")
    assert estimate.confidence == pytest.approx(0.9 * 0.75)


@pytest.mark.parametrize("appearance", [0.2, 0.5, float("inf"), float("nan")])
def test_a_frame_whose_appearance_loss_stays_at_tau_or_above_is_lost(appearance):
    estimate = judged(appearance)
    assert (estimate.status, estimate.confidence) == (Status.LOST, 0.0)
    assert "appearance loss" in estimate.reason
    assert "0.2" in estimate.reason


def test_a_numerical_failure_is_lost_with_its_own_reason():
    estimate = judged(failure="the loss became nan in iteration 3")
    assert (estimate.status, estimate.reason) == (Status.LOST, "the loss became nan in iteration 3")


def test_a_silhouette_that_disagrees_is_uncertain():
    estimate = judged(silhouette=0.3)
    assert estimate.status is Status.UNCERTAIN
    assert "0.30" in estimate.reason


def test_without_a_mask_a_frame_is_uncertain_and_its_silhouette_not_looked_at():
    estimate = judged(silhouette=5.0, has_mask=False)
    assert estimate.status is Status.UNCERTAIN
    assert "no initial mask" in estimate.reason
    assert estimate == judged(silhouette=0.0, has_mask=False)


def test_confidence_falls_with_either_loss_and_stays_in_its_range():
    assert judged(0.05).confidence > judged(0.1).confidence > judged(0.1, silhouette=0.2).confidence
    assert judged(0.0, 0.0).confidence == 1
    assert judged(silhouette=4.0).confidence == 0
