"""Masks of keyframes that are exact agree with each other, and stand in the frames after them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from online_runs import FRAMES, estimate_of, known_run, true_mask, turning_clip, with_true_masks

from tracking3d.config.loading import load_config
from tracking3d.estimation.estimate import MaskSource
from tracking3d.estimation.online.masks import (
    fuse_mask,
    initial_mask_weight,
    mask_agreement,
    measure_mask_agreement,
)
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.solver_state import MaskAgreement
from tracking3d.features.rgb import RgbEncoder


def test_exact_masks_of_keyframes_agree():
    state, _ = known_run(FRAMES)
    assert len(state.object_map.keyframes) >= 4
    assert mask_agreement(state.object_map, state.camera).weight > 0.9


def test_masks_with_background_on_another_side_each_do_not():
    state, _ = known_run(FRAMES)
    spoiled = tuple(
        replace(view, mask=view.mask | np.roll(view.mask, (-1) ** number * 6, number % 2))
        for number, view in enumerate(state.object_map.keyframes)
    )
    assert mask_agreement(replace(state.object_map, keyframes=spoiled), state.camera).weight < 0.1


def test_it_is_measured_again_when_there_are_half_as_many_keyframes_more():
    state, _ = known_run(FRAMES)
    count = len(state.object_map.keyframes)
    found = measure_mask_agreement(state).mask_agreement
    assert found.weight > 0.9 and found.beyond < 0.1 and found.keyframes == count
    just_now = replace(state, mask_agreement=replace(found, weight=0.3))
    assert measure_mask_agreement(just_now) is just_now
    earlier = replace(state, mask_agreement=MaskAgreement(0.3, 0.5, count // 2))
    assert measure_mask_agreement(earlier).mask_agreement == found


@pytest.mark.parametrize(
    ("beyond", "weight"), [(0, 1.0), (10, 1.0), (15, 1.0), (20, 0.5), (25, 0.0), (60, 0.0)]
)
def test_a_mask_that_reaches_further_beyond_the_silhouette_than_usual_has_less_weight(beyond, weight):
    silhouette = np.arange(200) < 100
    mask = np.roll(silhouette, beyond)  # so many of its hundred pixels lie beyond
    agreement = MaskAgreement(1.0, 0.1, 4)
    assert initial_mask_weight(agreement, mask, silhouette) == pytest.approx(weight)


def test_what_hides_a_part_of_the_object_takes_nothing_from_the_weight():
    silhouette = np.arange(200) < 100
    assert initial_mask_weight(MaskAgreement(0.9, 0.0, 4), np.arange(200) < 30, silhouette) == 0.9
    assert initial_mask_weight(MaskAgreement(0.9, 0.0, 4), np.zeros(200, bool), silhouette) == 0.9


def test_a_mask_that_stands_is_not_redrawn():
    view = known_run(FRAMES)[0].object_map.keyframes[-1]
    silhouette = np.roll(view.mask, 4, 0)
    stands, redrawn = (
        fuse_mask(silhouette, view.mask, view.observation, 0.9, None, None, one) for one in (1.0, 0.0)
    )
    assert stands.source is MaskSource.INITIAL
    np.testing.assert_array_equal(stands.mask, view.mask)
    assert (redrawn.mask != view.mask).any()


def test_boxes_in_a_text_file_are_no_masks():
    for path, given in (("masks", True), ("masks.npz", True), ("groundtruth.txt", False)):
        config = load_config(overrides=["tracker.name=precomputed", f"tracker.path={path}"])
        assert config.has_given_masks == given
    assert not load_config().has_given_masks


def test_the_solver_measures_it_for_given_masks_only():
    config = load_config(overrides=["object.frequency=7", "tracker.name=precomputed", "tracker.path=masks"])
    asked = OnlineSolver(config, turning_clip().camera, RgbEncoder())
    state, estimates = None, []
    for shown, mask in with_true_masks():
        given = estimate_of(mask)
        state, estimate = asked.init(shown, given) if state is None else asked.step(state, shown, given)
        estimates.append(estimate)
    assert state.mask_agreement.weight > 0.9
    last = estimates[-1]
    np.testing.assert_array_equal(last.mask, true_mask(last.index))
    assert any((one.mask != true_mask(one.index)).any() for one in known_run(FRAMES)[1][-3:])
