"""Frames without a mask, and frames that fail: each is answered, and the run goes on unharmed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from short_runs import estimate_of, frame, known_run, quick_solver, revised, run, true_mask

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.paper.problem import Losses, Problem
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import MaskEstimate
from tracking3d_bench.evaluation.metrics import mask_iou

PRESETS = pytest.mark.parametrize("preset", ["paper", "rerendering"])
FAILS = {"tau": 1e-6}


# Frames without a mask


@pytest.mark.parametrize("absent", [None, np.zeros((80, 100), bool)], ids=["none", "empty"])
@PRESETS
def test_a_frame_without_a_mask_is_tracked(preset, absent):
    estimates, _ = run(quick_solver(preset), (5, 6), {5: absent}, after=known_run(preset, 5))
    estimate = estimates[5]
    assert estimate.status is Status.UNCERTAIN
    assert "no initial mask" in estimate.reason
    assert estimate.initial_mask is None
    assert estimate.confidence > 0
    assert mask_iou(estimate.mask, estimates[4].mask) > 0.6
    assert estimates[6].initial_mask is not None


def test_a_gap_of_several_frames_is_tracked_through():
    before = known_run("rerendering", 4)
    final, _ = run(quick_solver("rerendering"), range(4, 9), dict.fromkeys((4, 5, 6, 7)), before)
    assert all(mask_iou(estimate.mask, true_mask(estimate.index)) > 0.6 for estimate in final[4:])
    assert final[8].status is Status.TRACKED


def test_a_gap_within_the_first_frames_is_tracked_through():
    estimates, _ = run(quick_solver("rerendering", solver={"init_frames": 4}), range(5), {1: None, 2: None})
    final = revised(estimates)
    assert all(mask_iou(estimate.mask, true_mask(estimate.index)) > 0.6 for estimate in final)
    assert [estimate.initial_mask is None for estimate in final] == [False, True, True, False, False]


def test_frames_that_are_missing_altogether_are_passed_over():
    estimates, _ = run(quick_solver("rerendering"), (3, 4, 7, 8), after=known_run("rerendering", 2))
    assert [estimate.index for estimate in estimates] == [0, 1, 3, 4, 7, 8]
    assert all(mask_iou(estimate.mask, true_mask(estimate.index)) > 0.6 for estimate in estimates)


# Failure is data


@pytest.mark.parametrize("mask", [None, np.zeros((80, 100), bool)], ids=["none", "empty"])
def test_the_first_frame_must_have_a_mask(mask):
    with pytest.raises(InputError, match=r"^frame 0 .*give another box or mask"):
        quick_solver().init(frame(0), estimate_of(mask))


@PRESETS
def test_a_frame_that_is_not_explained_is_lost_and_answered_with_its_initial_mask(preset):
    estimates, state = run(quick_solver(preset, solver=FAILS), range(3))
    for estimate in estimates[1:]:
        assert (estimate.status, estimate.confidence) == (Status.LOST, 0.0)
        assert "appearance loss" in estimate.reason
        np.testing.assert_array_equal(estimate.mask, true_mask(estimate.index))
        assert not estimate.keyframe
    assert len(state.keyframes) <= 1


def test_a_lost_frame_without_a_mask_has_an_empty_answer():
    estimates, _ = run(quick_solver("paper", solver=FAILS), range(3), {2: None})
    assert estimates[2].status is Status.LOST
    assert estimates[2].initial_mask is None
    assert not estimates[2].mask.any()


class BrokenEncoder(RgbEncoder):
    """The colours, but not a number in chosen calls."""

    def __init__(self, *broken: int) -> None:
        self.broken, self.calls = broken, 0

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return images * math.nan if self.calls - 1 in self.broken else images


@PRESETS
def test_a_frame_whose_loss_is_no_number_is_lost_and_the_run_goes_on(preset):
    estimates, state = run(quick_solver(preset, BrokenEncoder(0)), range(4, 8), after=known_run(preset, 4))
    assert (estimates[4].status, estimates[4].confidence) == (Status.LOST, 0.0)
    assert "nan" in estimates[4].reason
    np.testing.assert_array_equal(estimates[4].mask, true_mask(4))
    assert np.isfinite(estimates[4].T_cam_obj).all()
    for estimate in estimates[5:]:
        assert estimate.status is not Status.LOST, estimate.reason
        assert math.isfinite(estimate.losses["appearance"])
    assert state.texture.isfinite().all()
    assert all(keyframe.observation.index != 4 for keyframe in state.keyframes)


def test_a_broken_frame_leaves_shape_and_texture_as_they_were():
    solver = quick_solver("rerendering", BrokenEncoder(0))
    _, before = known_run("rerendering", 5)
    after, estimate = solver.step(before, frame(5), estimate_of(true_mask(5)))
    assert estimate.status is Status.LOST
    assert torch.equal(after.offsets, before.offsets)
    assert torch.equal(after.texture, before.texture)
    assert after.keyframes == before.keyframes


def test_a_lost_frame_leaves_shape_and_texture_as_they_were():
    _, before = known_run("rerendering", 5)
    solver = quick_solver("rerendering", solver=FAILS)
    after, estimate = solver.step(before, frame(9), estimate_of(true_mask(9)))
    assert estimate.status is Status.LOST
    assert torch.equal(after.offsets, before.offsets)
    assert torch.equal(after.texture, before.texture)


@pytest.mark.slow
@pytest.mark.parametrize("broken", [0, 1, 2])
@PRESETS
def test_a_broken_frame_among_the_first_does_not_spoil_the_others(preset, broken):
    estimates, state = run(quick_solver(preset, BrokenEncoder(broken)), range(8))
    final = revised(estimates)
    assert final[broken].status is Status.LOST
    assert "nan" in final[broken].reason
    np.testing.assert_array_equal(final[broken].mask, true_mask(broken))
    for estimate in final[5:]:
        assert estimate.status is not Status.LOST, estimate.reason
        assert mask_iou(estimate.mask, true_mask(estimate.index)) > 0.5
    assert state.waiting is None


def test_an_infinite_loss_in_the_middle_of_a_frame_loses_that_frame_only(monkeypatch):
    before, healthy = known_run("rerendering", 4), Problem.losses

    def failing(self: Problem, parameters) -> Losses:
        losses = healthy(self, parameters)
        return replace(losses, features=losses.features + (math.inf if 4 in self.batch.index else 0.0))

    monkeypatch.setattr(Problem, "losses", failing)
    estimates, _ = run(quick_solver("rerendering"), range(4, 7), after=before)
    assert [estimate.status is Status.LOST for estimate in estimates] == [index == 4 for index in range(7)]
    assert "inf" in estimates[4].reason


def test_an_object_that_leaves_the_picture_stops_nothing():
    away = MaskEstimate(None)
    solver = quick_solver("rerendering")
    _, state = known_run("rerendering", 4)
    far = state.last[0]
    for shift in (
        [50.0, 0.0, 0.0],
        [0.0, 0.0, -2.0],
        [0.0, 0.0, 0.91 - far.translation[2]],
        [0.0, 0.0, -20.0],
    ):
        moved = replace(far, translation=far.translation + torch.tensor(shift))
        _, estimate = solver.step(replace(state, last=(moved, 3), before=None), frame(4), away)
        assert estimate.status is not Status.TRACKED
        assert np.isfinite(estimate.T_cam_obj).all()
        assert estimate.initial_mask is None


def test_after_lost_frames_the_object_is_found_again():
    solver = quick_solver("rerendering")
    _, known = known_run("rerendering", 5)
    astray = replace(known.last[0], translation=known.last[0].translation + torch.tensor([1.5, 0.0, 0.5]))
    state, estimate = solver.step(
        replace(known, last=(astray, 8), before=None), frame(9), estimate_of(true_mask(9))
    )
    assert estimate.status is Status.TRACKED
    assert mask_iou(estimate.mask, true_mask(9)) > 0.6
    assert state.last[1] == 9
