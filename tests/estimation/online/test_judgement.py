"""A frame is judged by what is usual for its object, and by how many points agree."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from rendered_solids import pose_of

from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.judgement import (
    BELIEVED,
    ENOUGH_POINTS,
    SETTLED,
    Support,
    Usual,
    _doubt,
    judge,
    likelihood,
    looks_wrong,
    unusual,
)
from tracking3d.estimation.online.pose_refinement_types import PoseFit, PoseWeights

MANY, FEW = ENOUGH_POINTS, ENOUGH_POINTS - 1
USUAL = Usual(appearance=0.2, outline=0.3, overlap=0.9)


def fit(appearance=0.2, outline=0.3, overlap=0.9, unseen=0.0, points=0.1) -> PoseFit:
    return PoseFit(pose_of(), 1.0, appearance, outline, points, overlap, unseen, 100 * torch.eye(6), 5)


DOUBTFUL = fit(appearance=0.4)  # (0.4 - 0.26 - 0.05) / 0.2 = 0.45 above what is usual
WRONG = fit(appearance=0.7)  # 1.95


def test_what_is_usual_is_a_running_mean():
    usual = USUAL.updated(fit(appearance=0.4, outline=0.1, overlap=0.8))
    assert (usual.appearance, usual.outline, usual.overlap) == pytest.approx((0.22, 0.28, 0.89))
    for _ in range(100):
        usual = usual.updated(fit(appearance=0.4, outline=0.1, overlap=0.8))
    assert (usual.appearance, usual.outline, usual.overlap) == pytest.approx((0.4, 0.1, 0.8), abs=1e-4)


def test_what_is_usual_does_not_follow_a_decay():
    usual = USUAL
    for _ in range(SETTLED):
        usual = usual.updated(fit())
    assert usual.sound == pytest.approx((0.2, 0.3, 0.9))
    slipping = [fit(0.2 + 0.01 * n, 0.3 + 0.05 * n, 0.9 - 0.01 * n) for n in range(50)]
    for one in slipping:
        usual = usual.updated(one)
    assert unusual(slipping[-1], usual, 1.0) > 1
    # Losses as large from the beginning on are usual.
    other = Usual()
    for _ in range(100):
        other = other.updated(slipping[-1])
    assert unusual(slipping[-1], other, 1.0) < 0.5


def test_what_is_usual_may_become_better():
    usual = USUAL
    for _ in range(200):
        usual = usual.updated(fit(0.05, 0.02, 0.99))
    assert (usual.appearance, usual.outline, usual.overlap) == pytest.approx((0.05, 0.02, 0.99), abs=1e-3)


def test_excess_is_the_largest_of_pixels_outline_and_overlap():
    assert unusual(fit(), USUAL, 1.0) == pytest.approx(-0.54)
    assert unusual(DOUBTFUL, USUAL, 1.0) == pytest.approx(0.45)
    assert unusual(fit(outline=1.55), USUAL, 1.0) == pytest.approx(1.0)
    assert unusual(fit(overlap=0.515), USUAL, 1.0) == pytest.approx(1.0)


def test_a_mask_that_is_not_believed_contradicts_nothing():
    assert unusual(fit(outline=3.0, overlap=0.1), USUAL, 0.02) < 0.1


def test_texture_that_was_never_seen_is_no_evidence_against_a_pose():
    charge = PoseWeights().unseen
    for unseen in (0.3, 0.6, 0.9, 1.0):
        mixed = fit(appearance=(1 - unseen) * 0.2 + unseen * charge, unseen=unseen)
        assert unusual(mixed, USUAL, 1.0) <= 0
        assert not looks_wrong(mixed, USUAL, Support(FEW))
    # What is known of it still speaks.
    half_wrong = fit(appearance=0.5 * 0.9 + 0.5 * charge, unseen=0.5)
    assert unusual(half_wrong, USUAL, 1.0) > 1
    # And the less of it is known, the less loudly: an eighth of (0.9 - 0.31) / 0.2.
    hardly_known = fit(appearance=0.1 * 0.9 + 0.9 * charge, unseen=0.9)
    assert unusual(hardly_known, USUAL, 1.0) == pytest.approx(2.95 / 8)


def test_without_points_any_excess_looks_wrong():
    assert not looks_wrong(fit(), USUAL, Support(FEW))
    assert looks_wrong(DOUBTFUL, USUAL, Support(FEW))


def test_with_points_only_a_large_excess_or_points_off_place_do():
    assert not looks_wrong(DOUBTFUL, USUAL, Support(MANY))
    assert looks_wrong(WRONG, USUAL, Support(MANY))
    assert looks_wrong(fit(points=1.1), USUAL, Support(MANY))
    assert not looks_wrong(fit(points=1.1), USUAL, Support(FEW))


def test_confidence_rises_with_the_points_that_agree_and_status_goes_with_it():
    verdicts = [judge(fit(), USUAL, Support(points)) for points in (0, MANY, 60, 400)]
    said = [one.confidence for one in verdicts]
    assert said == sorted(said) and said[0] < BELIEVED < 0.7 < said[-1]
    for verdict in verdicts:
        tracked = verdict.confidence >= BELIEVED
        assert verdict.status is (Status.TRACKED if tracked else Status.UNCERTAIN)
        assert bool(verdict.reason) == (not tracked)
    assert "few points" in verdicts[0].reason


def test_without_a_mask_confidence_is_even_at_most():
    assert judge(fit(), USUAL, Support(MANY, has_mask=False)).confidence <= 0.5


def test_the_reason_names_what_speaks_most_against_the_pose():
    firm = replace(fit(), information=1e4 * torch.eye(6))
    loose = replace(fit(), information=torch.diag(torch.tensor([1e4, 1e4, 1e4, 1e4, 1e-3, 1e4])))
    against = {
        "overlap too little": (replace(firm, overlap=0.5), Support(400)),
        "never seen before": (replace(firm, unseen=0.6), Support(400)),
        "too few points": (firm, Support(0)),
        "too loosely": (replace(firm, points=0.9, overlap=0.8), Support(100)),
        "turning about the camera's axis (0.0, 1.0, 0.0)": (replace(loose, overlap=0.8), Support(200)),
    }
    for words, (one, support) in against.items():
        assert words.replace("overlap too little", "overlap") in _doubt(one, support), words


def test_a_wrong_mask_is_no_evidence_where_points_tell_that_it_is_wrong():
    missed = fit(overlap=0.4, outline=2.0)
    assert likelihood(missed, Support(150, mask_weight=0.02)) > likelihood(missed, Support(150)) + 0.3


def test_no_mask_and_no_points_is_lost():
    verdict = judge(fit(), USUAL, Support(FEW, has_mask=False))
    assert verdict.status is Status.LOST
    assert "no mask" in verdict.reason
    assert judge(fit(), USUAL, Support(MANY, has_mask=False)).status is Status.TRACKED


def test_neither_pixels_nor_points_is_lost_and_says_what_disagreed():
    verdict = judge(WRONG, USUAL, Support(FEW))
    assert verdict.status is Status.LOST
    assert "0.70" in verdict.reason
    assert "0.90" in verdict.reason
    assert str(FEW) in verdict.reason
    assert verdict.confidence < 0.1
    # Only what disagrees is said to.
    assert "though one fits the mask" in verdict.reason
    assert "nor the mask" in judge(fit(appearance=0.7, overlap=0.5), USUAL, Support(FEW)).reason


def test_a_plain_object_whose_outline_fits_is_not_lost_though_its_shades_change():
    plain = Support(0, plain=True)
    verdict = judge(WRONG, USUAL, plain)
    assert verdict.status is Status.UNCERTAIN and "outline agrees" in verdict.reason
    assert verdict.confidence <= 0.2
    assert judge(fit(appearance=0.7, overlap=0.8), USUAL, plain).status is Status.LOST
    assert judge(fit(appearance=0.7, outline=0.5), USUAL, plain).status is Status.LOST
    assert judge(WRONG, USUAL, replace(plain, has_mask=False)).status is Status.LOST
    # After a loss its pixels have to agree, too.
    assert judge(fit(), USUAL, plain, astray=True).status is Status.UNCERTAIN
    assert judge(DOUBTFUL, USUAL, plain, astray=True).status is Status.LOST


def test_a_guessed_turn_that_explains_nothing_is_lost_whatever_points_agree_with_it():
    verdict = judge(WRONG, USUAL, Support(MANY), guessed=True)
    assert verdict.status is Status.LOST and "guess" in verdict.reason and verdict.confidence < 0.1
    assert judge(WRONG, USUAL, Support(MANY)).status is Status.UNCERTAIN
    assert judge(fit(), USUAL, Support(MANY), guessed=True).status is Status.TRACKED


def test_points_against_pixels_is_uncertain():
    verdict = judge(WRONG, USUAL, Support(MANY))
    assert verdict.status is Status.UNCERTAIN
    assert "points agree, pixels do not" in verdict.reason
    assert verdict.confidence < judge(fit(), USUAL, Support(MANY)).confidence


def test_a_side_that_was_never_seen_is_uncertain_without_points():
    unseen = fit(appearance=0.46, unseen=0.9)
    verdict = judge(unseen, USUAL, Support(FEW))
    assert verdict.status is Status.UNCERTAIN
    assert "never seen" in verdict.reason
    assert judge(unseen, USUAL, Support(MANY)).confidence > verdict.confidence


def test_a_good_fit_is_likely_right_and_each_contradiction_makes_it_less_so():
    many = Support(200)
    good = likelihood(fit(), many)
    assert good > 0.6
    worse = [fit(overlap=0.6), fit(unseen=0.2), fit(points=0.8)]
    assert all(likelihood(one, many) < good for one in worse)
    assert likelihood(fit(), Support(200, strays=0.3)) < good
    assert likelihood(fit(overlap=0.5, unseen=0.3), Support(0)) < 0.1


def test_beyond_the_range_it_was_fitted_on_nothing_changes():
    assert likelihood(fit(overlap=0.4), Support(9)) == likelihood(fit(overlap=0.0), Support(9))
    assert likelihood(fit(), Support(400)) == likelihood(fit(), Support(4000))


def test_after_a_loss_only_what_is_believed_is_the_object():
    verdict = judge(fit(), USUAL, Support(3), astray=True)
    assert verdict.status is Status.LOST and "after the loss" in verdict.reason
    assert judge(fit(), USUAL, Support(100), astray=True).status is Status.TRACKED


def test_after_a_loss_what_was_never_seen_is_no_side_of_the_object():
    unseen = fit(appearance=0.46, unseen=0.9)
    verdict = judge(unseen, USUAL, Support(FEW), astray=True)
    assert verdict.status is Status.LOST and verdict.confidence < 0.3
    # Points that agree tell that it is back.
    assert judge(unseen, USUAL, Support(MANY), astray=True).status is not Status.LOST
