"""A frame is judged by what is usual for its object, and by how many points agree."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from rendered_solids import pose_of

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.state.confidence import (
    ENOUGH_POINTS,
    SETTLED,
    LossBaseline,
    PoseEvidence,
    _doubt,
    assess_pose,
    confidence_features,
    is_misfit,
    likelihood,
    loss_excess,
    needs_relocalization,
)
from tracking3d.frames import TRACKED_CONFIDENCE

MANY, FEW = ENOUGH_POINTS, ENOUGH_POINTS - 1
USUAL = LossBaseline(appearance=0.2, outline=0.3, overlap=0.9)


def fit(appearance=0.2, outline=0.3, overlap=0.9, unseen=0.0, points=0.1) -> PoseFit:
    return PoseFit(pose_of(), 1.0, appearance, outline, points, overlap, unseen, 100 * torch.eye(6), 5)


DOUBTFUL = fit(appearance=0.4)  # (0.4 - 0.26 - 0.05) / 0.2 = 0.45 above what is usual
WRONG = fit(appearance=0.7)  # 1.95


def test_what_is_usual_is_a_running_mean():
    baseline = USUAL.update(fit(appearance=0.4, outline=0.1, overlap=0.8))
    assert (baseline.appearance, baseline.outline, baseline.overlap) == pytest.approx((0.22, 0.28, 0.89))
    for _ in range(100):
        baseline = baseline.update(fit(appearance=0.4, outline=0.1, overlap=0.8))
    assert (baseline.appearance, baseline.outline, baseline.overlap) == pytest.approx(
        (0.4, 0.1, 0.8), abs=1e-4
    )


def test_what_is_usual_does_not_follow_a_decay():
    baseline = USUAL
    for _ in range(SETTLED):
        baseline = baseline.update(fit())
    assert baseline.sound == pytest.approx((0.2, 0.3, 0.9))
    slipping = [fit(0.2 + 0.01 * n, 0.3 + 0.05 * n, 0.9 - 0.01 * n) for n in range(50)]
    for one in slipping:
        baseline = baseline.update(one)
    assert loss_excess(slipping[-1], baseline, 1.0) > 1
    # Losses as large from the beginning on are usual.
    other = LossBaseline()
    for _ in range(100):
        other = other.update(slipping[-1])
    assert loss_excess(slipping[-1], other, 1.0) < 0.5


def test_what_is_usual_may_become_better():
    baseline = USUAL
    for _ in range(200):
        baseline = baseline.update(fit(0.05, 0.02, 0.99))
    assert (baseline.appearance, baseline.outline, baseline.overlap) == pytest.approx(
        (0.05, 0.02, 0.99), abs=1e-3
    )


def test_a_misfit_is_worse_than_the_first_frames_not_than_the_last_ones():
    baseline = LossBaseline()
    for _ in range(SETTLED):
        assert not is_misfit(fit(appearance=2.0, overlap=0.1), baseline)
        baseline = baseline.update(fit(appearance=0.1, overlap=0.95))
    appearance, _, overlap = baseline.sound
    for _ in range(50):
        baseline = baseline.update(fit(appearance=0.5, overlap=0.85))
    assert not is_misfit(fit(appearance=2 * appearance, overlap=overlap - 0.04), baseline)
    assert is_misfit(fit(appearance=2 * appearance + 0.15, overlap=overlap), baseline)
    assert is_misfit(fit(appearance=0.1, overlap=overlap - 0.06), baseline)
    unseen = fit(appearance=0.1 + 0.5 * PoseWeights().unseen, unseen=0.5)
    assert not is_misfit(replace(unseen, overlap=overlap), baseline)


def test_excess_is_the_largest_of_pixels_outline_and_overlap():
    assert loss_excess(fit(), USUAL, 1.0) == pytest.approx(-0.54)
    assert loss_excess(DOUBTFUL, USUAL, 1.0) == pytest.approx(0.45)
    assert loss_excess(fit(outline=1.55), USUAL, 1.0) == pytest.approx(1.0)
    assert loss_excess(fit(overlap=0.515), USUAL, 1.0) == pytest.approx(1.0)


def test_a_mask_that_is_not_believed_contradicts_nothing():
    assert loss_excess(fit(outline=3.0, overlap=0.1), USUAL, 0.02) < 0.1


def test_texture_that_was_never_seen_is_no_evidence_against_a_pose():
    charge = PoseWeights().unseen
    for unseen in (0.3, 0.6, 0.9, 1.0):
        mixed = fit(appearance=(1 - unseen) * 0.2 + unseen * charge, unseen=unseen)
        assert loss_excess(mixed, USUAL, 1.0) <= 0
        assert not needs_relocalization(mixed, USUAL, PoseEvidence(FEW))
    # What is known of it still speaks.
    half_wrong = fit(appearance=0.5 * 0.9 + 0.5 * charge, unseen=0.5)
    assert loss_excess(half_wrong, USUAL, 1.0) > 1
    # And the less of it is known, the less loudly: an eighth of (0.9 - 0.31) / 0.2.
    hardly_known = fit(appearance=0.1 * 0.9 + 0.9 * charge, unseen=0.9)
    assert loss_excess(hardly_known, USUAL, 1.0) == pytest.approx(2.95 / 8)


def test_without_points_any_excess_looks_wrong():
    assert not needs_relocalization(fit(), USUAL, PoseEvidence(FEW))
    assert needs_relocalization(DOUBTFUL, USUAL, PoseEvidence(FEW))


def test_with_points_only_a_large_excess_or_points_off_place_do():
    assert not needs_relocalization(DOUBTFUL, USUAL, PoseEvidence(MANY))
    assert needs_relocalization(WRONG, USUAL, PoseEvidence(MANY))
    assert needs_relocalization(fit(points=1.1), USUAL, PoseEvidence(MANY))
    assert not needs_relocalization(fit(points=1.1), USUAL, PoseEvidence(FEW))


def test_confidence_rises_with_the_points_that_agree_and_status_goes_with_it():
    verdicts = [assess_pose(fit(), USUAL, PoseEvidence(points)) for points in (0, MANY, 60, 400)]
    said = [one.confidence for one in verdicts]
    assert said == sorted(said) and said[0] < TRACKED_CONFIDENCE < 0.9 < said[-1]
    for verdict in verdicts:
        tracked = verdict.confidence >= TRACKED_CONFIDENCE
        assert verdict.status is (Status.TRACKED if tracked else Status.UNCERTAIN)
        assert bool(verdict.reason) == (not tracked)
    assert "few inliers" in verdicts[0].reason


def test_without_a_mask_a_frame_is_just_tracked_at_most():
    assert assess_pose(fit(), USUAL, PoseEvidence(MANY, has_mask=False)).confidence <= TRACKED_CONFIDENCE


def test_the_reason_names_what_speaks_most_against_the_pose():
    firm = replace(fit(), information=1e4 * torch.eye(6))
    loose = replace(fit(), information=torch.diag(torch.tensor([1e4, 1e4, 1e4, 1e4, 1e-3, 1e4])))
    against = {
        "overlap too little": (replace(firm, overlap=0.5), PoseEvidence(400)),
        "not been seen before": (replace(firm, unseen=0.6), PoseEvidence(400)),
        "too few inliers": (firm, PoseEvidence(0)),
        "hardly any texture": (firm, PoseEvidence(0, untextured=True)),
        "no points that last": (firm, PoseEvidence(0, untextured=True, has_texture=True)),
        "too many outliers": (replace(firm, overlap=1.0), PoseEvidence(400, outlier_ratio=0.3)),
        "rotation about camera axis (0.0, 1.0, 0.0)": (replace(loose, overlap=0.8), PoseEvidence(200)),
    }
    for words, (one, evidence) in against.items():
        assert words in _doubt(one, evidence), words


def test_of_a_finished_plain_map_the_lead_over_other_rotations_decides():
    loose = replace(fit(overlap=0.98), information=torch.zeros(6, 6))
    first, second = (
        assess_pose(loose, USUAL, PoseEvidence(0, untextured=True, lead=lead)) for lead in (0.9, 0.1)
    )
    assert first.status is Status.TRACKED and second.status is Status.UNCERTAIN
    assert assess_pose(fit(overlap=0.85), USUAL, PoseEvidence(0, lead=0.9)).status is Status.UNCERTAIN
    assert assess_pose(loose, USUAL, PoseEvidence(0, untextured=True)).status is Status.UNCERTAIN


def test_rotation_about_a_free_axis_is_not_judged_but_the_outline_is():
    free = PoseEvidence(0, untextured=True, free_axis=np.array([0.0, 1.0, 0.0]))
    loose = replace(fit(overlap=0.96, unseen=0.3), information=torch.zeros(6, 6))
    assert assess_pose(loose, USUAL, free).status is Status.TRACKED
    assert assess_pose(loose, USUAL, PoseEvidence(0, untextured=True)).status is Status.UNCERTAIN
    verdict = assess_pose(fit(overlap=0.88), USUAL, free)
    assert verdict.status is Status.UNCERTAIN and "overlap too little" in verdict.reason


def test_a_wrong_mask_is_no_evidence_where_points_tell_that_it_is_wrong():
    missed = fit(overlap=0.4, outline=2.0)
    assert (
        likelihood(missed, PoseEvidence(150, mask_weight=0.02)) > likelihood(missed, PoseEvidence(150)) + 0.3
    )


def test_no_mask_and_no_points_is_lost():
    verdict = assess_pose(fit(), USUAL, PoseEvidence(FEW, has_mask=False))
    assert verdict.status is Status.LOST
    assert "no mask" in verdict.reason
    assert assess_pose(fit(), USUAL, PoseEvidence(MANY, has_mask=False)).status is Status.TRACKED


def test_neither_pixels_nor_points_is_lost_and_says_what_disagreed():
    verdict = assess_pose(WRONG, USUAL, PoseEvidence(FEW))
    assert verdict.status is Status.LOST
    assert "0.70" in verdict.reason
    assert "0.90" in verdict.reason
    assert str(FEW) in verdict.reason
    assert verdict.confidence < 0.1
    assert "though one fits the mask" in verdict.reason
    elsewhere = assess_pose(fit(appearance=0.7, overlap=0.5), USUAL, PoseEvidence(FEW))
    assert "fits the mask" not in elsewhere.reason


def test_a_plain_object_whose_outline_fits_is_not_lost_though_its_shades_change():
    plain = PoseEvidence(0, untextured=True)
    verdict = assess_pose(WRONG, USUAL, plain)
    assert verdict.status is Status.UNCERTAIN and "outline fits" in verdict.reason
    assert verdict.confidence <= 0.5
    assert assess_pose(fit(appearance=0.7, overlap=0.8), USUAL, plain).status is Status.LOST
    assert assess_pose(fit(appearance=0.7, outline=0.5), USUAL, plain).status is Status.LOST
    assert assess_pose(WRONG, USUAL, replace(plain, has_mask=False)).status is Status.LOST
    # After a loss its pixels have to agree, too.
    assert assess_pose(fit(), USUAL, plain, astray=True).status is Status.UNCERTAIN
    assert assess_pose(DOUBTFUL, USUAL, plain, astray=True).status is Status.LOST


def test_a_guessed_turn_that_explains_nothing_is_lost_whatever_points_agree_with_it():
    verdict = assess_pose(WRONG, USUAL, PoseEvidence(MANY), guessed=True)
    assert (
        verdict.status is Status.LOST and "no pose hypothesis" in verdict.reason and verdict.confidence < 0.1
    )
    assert assess_pose(WRONG, USUAL, PoseEvidence(MANY)).status is Status.UNCERTAIN
    assert assess_pose(fit(), USUAL, PoseEvidence(MANY), guessed=True).status is Status.TRACKED


def test_points_against_pixels_is_uncertain():
    verdict = assess_pose(WRONG, USUAL, PoseEvidence(MANY))
    assert verdict.status is Status.UNCERTAIN
    assert "points fit, the appearance does not" in verdict.reason
    assert verdict.confidence < assess_pose(fit(), USUAL, PoseEvidence(MANY)).confidence


def test_a_side_that_was_never_seen_is_uncertain_without_points():
    unseen = fit(appearance=0.46, unseen=0.9)
    verdict = assess_pose(unseen, USUAL, PoseEvidence(FEW))
    assert verdict.status is Status.UNCERTAIN
    assert "a new side" in verdict.reason
    assert assess_pose(unseen, USUAL, PoseEvidence(MANY)).confidence > verdict.confidence


def test_a_good_fit_is_likely_right_and_each_contradiction_makes_it_less_so():
    many = PoseEvidence(200)
    good = likelihood(fit(), many)
    assert good > 0.6
    worse = [fit(overlap=0.6), fit(unseen=0.2), fit(points=0.8)]
    assert all(likelihood(one, many) < good for one in worse)
    assert likelihood(fit(), PoseEvidence(200, outlier_ratio=0.3)) < good
    assert likelihood(fit(overlap=0.5, unseen=0.3), PoseEvidence(0)) < 0.1


@pytest.mark.parametrize("inliers", [40, 160])
def test_the_deviation_is_that_of_poses_fitted_to_noisy_points(inliers):
    """Rotation about one axis, by least squares: points 100 pixels away move by 1.75 pixels a degree."""
    rng, scale, sigma, arm = np.random.default_rng(0), 2.0, 1.0, 100.0
    residual = rng.normal(0, sigma, (2000, inliers, 2))
    turned = np.degrees(residual[..., 0].mean(1) / arm)
    loss = float(np.log1p((residual**2).sum(2) / (8 * scale) ** 2).mean()) * 64  # far inside the robust scale
    cost = (arm * np.radians(10) / scale) ** 2  # of 10 degrees, of the mean over the points
    said = confidence_features(
        {"appearance": 0.2, "outline": 0.3, "points": loss},
        {"inliers": inliers, "unseen_ratio": 0, "mask_iou": 1, "mask_confidence": 1, "min_curvature": cost},
    )
    assert math.exp(said["deviation"]) == pytest.approx(turned.std(), rel=0.15)


def test_many_points_that_agree_loosely_are_tracked_where_a_rotation_is_cheap():
    """A video of a thing that turns little: 165 inliers, no outliers, loss 0.7."""
    cheap = replace(fit(overlap=0.95, points=0.7), information=30 * torch.eye(6))
    assert assess_pose(cheap, USUAL, PoseEvidence(165)).status is Status.TRACKED
    assert assess_pose(cheap, USUAL, PoseEvidence(16)).status is Status.UNCERTAIN


def test_beyond_the_range_it_was_fitted_on_nothing_changes():
    assert likelihood(fit(overlap=0.4), PoseEvidence(9)) == likelihood(fit(overlap=0.0), PoseEvidence(9))
    assert likelihood(fit(), PoseEvidence(4000)) == likelihood(fit(), PoseEvidence(40000))


def test_after_a_loss_only_what_is_believed_is_the_object():
    verdict = assess_pose(fit(), USUAL, PoseEvidence(3), astray=True)
    assert verdict.status is Status.LOST and "after a loss" in verdict.reason
    assert assess_pose(fit(), USUAL, PoseEvidence(100), astray=True).status is Status.TRACKED


def test_after_a_loss_what_was_never_seen_is_no_side_of_the_object():
    unseen = fit(appearance=0.46, unseen=0.9)
    verdict = assess_pose(unseen, USUAL, PoseEvidence(FEW), astray=True)
    assert verdict.status is Status.LOST and verdict.confidence < 0.3
    # Points that agree tell that it is back.
    assert assess_pose(unseen, USUAL, PoseEvidence(MANY), astray=True).status is not Status.LOST
