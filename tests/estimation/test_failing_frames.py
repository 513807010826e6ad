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
from tracking3d.evaluation.metrics import mask_iou
from tracking3d.features.rgb import RgbEncoder
from tracking3d.frames import MaskEstimate

PRESETS = pytest.mark.parametrize("preset", ["paper", "rerendering"])
FAILS = {"tau": 1e-6}


# Frames without a mask


@pytest.mark.parametrize("absent", [None, np.zeros((80, 100), bool)], ids=["none", "empty"])
@PRESETS
def test_a_frame_without_a_mask_is_tracked(preset, absent):
    answers, _ = run(quick_solver(preset), (5, 6), {5: absent}, after=known_run(preset, 5))
    answer = answers[5]
    assert answer.status is Status.UNCERTAIN
    assert "no initial mask" in answer.reason
    assert answer.initial_mask is None
    assert answer.confidence > 0
    assert mask_iou(answer.mask, answers[4].mask) > 0.6
    assert answers[6].initial_mask is not None


def test_a_gap_of_several_frames_is_tracked_through():
    before = known_run("rerendering", 4)
    final, _ = run(quick_solver("rerendering"), range(4, 9), dict.fromkeys((4, 5, 6, 7)), before)
    assert all(mask_iou(answer.mask, true_mask(answer.index)) > 0.6 for answer in final[4:])
    assert final[8].status is Status.TRACKED


def test_a_gap_within_the_first_frames_is_tracked_through():
    answers, _ = run(quick_solver("rerendering", solver={"start_frames": 4}), range(5), {1: None, 2: None})
    final = revised(answers)
    assert all(mask_iou(answer.mask, true_mask(answer.index)) > 0.6 for answer in final)
    assert [answer.initial_mask is None for answer in final] == [False, True, True, False, False]


def test_frames_that_are_missing_altogether_are_passed_over():
    answers, _ = run(quick_solver("rerendering"), (3, 4, 7, 8), after=known_run("rerendering", 2))
    assert [answer.index for answer in answers] == [0, 1, 3, 4, 7, 8]
    assert all(mask_iou(answer.mask, true_mask(answer.index)) > 0.6 for answer in answers)


# Failure is data


@pytest.mark.parametrize("mask", [None, np.zeros((80, 100), bool)], ids=["none", "empty"])
def test_the_first_frame_must_have_a_mask(mask):
    with pytest.raises(InputError, match=r"^frame 0 .*give another box or mask"):
        quick_solver().init(frame(0), estimate_of(mask))


@PRESETS
def test_a_frame_that_is_not_explained_is_lost_and_answered_with_its_initial_mask(preset):
    answers, state = run(quick_solver(preset, solver=FAILS), range(3))
    for answer in answers[1:]:
        assert (answer.status, answer.confidence) == (Status.LOST, 0.0)
        assert "appearance loss" in answer.reason
        np.testing.assert_array_equal(answer.mask, true_mask(answer.index))
        assert not answer.keyframe
    assert len(state.keyframes) <= 1


def test_a_lost_frame_without_a_mask_has_an_empty_answer():
    answers, _ = run(quick_solver("paper", solver=FAILS), range(3), {2: None})
    assert answers[2].status is Status.LOST
    assert answers[2].initial_mask is None
    assert not answers[2].mask.any()


class BrokenEncoder(RgbEncoder):
    """The colours, but not a number in chosen calls."""

    def __init__(self, *broken: int) -> None:
        self.broken, self.calls = broken, 0

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return images * math.nan if self.calls - 1 in self.broken else images


@PRESETS
def test_a_frame_whose_loss_is_no_number_is_lost_and_the_run_goes_on(preset):
    answers, state = run(quick_solver(preset, BrokenEncoder(0)), range(4, 8), after=known_run(preset, 4))
    assert (answers[4].status, answers[4].confidence) == (Status.LOST, 0.0)
    assert "nan" in answers[4].reason
    np.testing.assert_array_equal(answers[4].mask, true_mask(4))
    assert np.isfinite(answers[4].T_cam_obj).all()
    for answer in answers[5:]:
        assert answer.status is not Status.LOST, answer.reason
        assert math.isfinite(answer.losses["features"])
    assert state.texture.isfinite().all()
    assert all(keyframe.observation.index != 4 for keyframe in state.keyframes)


def test_a_broken_frame_leaves_shape_and_texture_as_they_were():
    solver = quick_solver("rerendering", BrokenEncoder(0))
    _, before = known_run("rerendering", 5)
    after, answer = solver.step(before, frame(5), estimate_of(true_mask(5)))
    assert answer.status is Status.LOST
    assert torch.equal(after.offsets, before.offsets)
    assert torch.equal(after.texture, before.texture)
    assert after.keyframes == before.keyframes


def test_a_lost_frame_leaves_shape_and_texture_as_they_were():
    _, before = known_run("rerendering", 5)
    solver = quick_solver("rerendering", solver=FAILS)
    after, answer = solver.step(before, frame(9), estimate_of(true_mask(9)))
    assert answer.status is Status.LOST
    assert torch.equal(after.offsets, before.offsets)
    assert torch.equal(after.texture, before.texture)


@pytest.mark.slow
@pytest.mark.parametrize("broken", [0, 1, 2])
@PRESETS
def test_a_broken_frame_among_the_first_does_not_spoil_the_others(preset, broken):
    answers, state = run(quick_solver(preset, BrokenEncoder(broken)), range(8))
    final = revised(answers)
    assert final[broken].status is Status.LOST
    assert "nan" in final[broken].reason
    np.testing.assert_array_equal(final[broken].mask, true_mask(broken))
    for answer in final[5:]:
        assert answer.status is not Status.LOST, answer.reason
        assert mask_iou(answer.mask, true_mask(answer.index)) > 0.5
    assert state.waiting is None


def test_an_infinite_loss_in_the_middle_of_a_frame_loses_that_frame_only(monkeypatch):
    before, healthy = known_run("rerendering", 4), Problem.losses

    def failing(self: Problem, parameters) -> Losses:
        losses = healthy(self, parameters)
        return replace(losses, features=losses.features + (math.inf if 4 in self.batch.index else 0.0))

    monkeypatch.setattr(Problem, "losses", failing)
    answers, _ = run(quick_solver("rerendering"), range(4, 7), after=before)
    assert [answer.status is Status.LOST for answer in answers] == [index == 4 for index in range(7)]
    assert "inf" in answers[4].reason


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
        _, answer = solver.step(replace(state, last=(moved, 3), before=None), frame(4), away)
        assert answer.status is not Status.TRACKED
        assert np.isfinite(answer.T_cam_obj).all()
        assert answer.initial_mask is None


def test_after_lost_frames_the_object_is_found_again():
    solver = quick_solver("rerendering")
    _, known = known_run("rerendering", 5)
    astray = replace(known.last[0], translation=known.last[0].translation + torch.tensor([1.5, 0.0, 0.5]))
    state, answer = solver.step(
        replace(known, last=(astray, 8), before=None), frame(9), estimate_of(true_mask(9))
    )
    assert answer.status is Status.TRACKED
    assert mask_iou(answer.mask, true_mask(9)) > 0.6
    assert state.last[1] == 9
