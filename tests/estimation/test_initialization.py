"""The first frames solved together: which rotations are tried, and that the best one wins."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from short_runs import quick_solver, run, short_clip

from tracking3d.estimation.paper.problem import Parameters
from tracking3d.estimation.paper.solver import (
    DIRECTIONS,
    RATES,
    PaperState,
    PosedObservation,
    hypotheses,
    initialize_jointly,
)
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about, rotation_angle
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors


@pytest.fixture(scope="module")
def waiting() -> tuple[PaperState, list[PosedObservation]]:
    """Five frames found one by one, and what is known after them."""
    _, state = run(quick_solver("rerendering", solver={"init_frames": 8}), range(5))
    return state, [keyframe for keyframe, _ in state.waiting]


def degrees(a: Parameters, position: int, b: Pose) -> float:
    return math.degrees(rotation_angle(a.quaternion[position], b.quaternion))


def test_no_hypothesis_moves_the_first_frame(waiting):
    state, frames = waiting
    for start in hypotheses(state, frames):
        assert degrees(start, 0, frames[0].pose) < 0.01


def test_translations_are_those_that_were_found(waiting):
    state, frames = waiting
    for start in hypotheses(state, frames):
        torch.testing.assert_close(start.translation, torch.stack([f.pose.translation for f in frames]))


def test_one_hypothesis_does_not_turn(waiting):
    state, frames = waiting
    still = hypotheses(state, frames)[0]
    assert max(degrees(still, position, frames[0].pose) for position in range(len(frames))) < 0.01


@pytest.mark.parametrize(
    ("axis", "mirrored"), [((1, 0, 0), (-1, 0, 0)), ((0, 1, 0), (0, -1, 0)), ((0, 0, 1), (0, 0, 1))]
)
def test_one_hypothesis_is_mirrored_in_depth(waiting, axis, mirrored):
    """Tilts out of the image plane look the same either way (Necker); turns within it do not."""
    state, frames = waiting
    first = frames[0]

    def tilted(about: tuple[int, ...]) -> Pose:
        turn = rotation_about(torch.tensor(about, dtype=torch.float32), 20)
        return from_matrix(turn @ first.pose.R, first.pose.translation)

    start = hypotheses(state, [first, PosedObservation(frames[1].observation, tilted(axis))])[1]
    assert degrees(start, 1, tilted(mirrored)) < 0.1


def test_the_others_turn_steadily_in_every_direction(waiting):
    state, frames = waiting
    turning = hypotheses(state, frames)[2:]
    assert len(turning) == DIRECTIONS * len(RATES)
    for number, start in enumerate(turning):
        rate = RATES[number % len(RATES)]
        angles = [degrees(start, position, frames[0].pose) for position in range(len(frames))]
        np.testing.assert_allclose(angles, [rate * position for position in range(len(frames))], atol=0.2)
    ends = [Pose(start.translation[-1], start.quaternion[-1]) for start in turning]
    apart = [degrees(a, -1, b) for i, a in enumerate(turning) for b in ends[:i]]
    assert min(apart) > 5


def test_rotations_of_a_batch_are_those_of_one_frame_after_another(waiting):
    """Frames may be far apart: none turns by more than 60 degrees."""
    state, found = waiting
    frames = [
        PosedObservation(replace(keyframe.observation, index=index), keyframe.pose)
        for keyframe, index in zip(found, (3, 4, 7, 12, 30), strict=True)
    ]
    first = frames[0].pose
    flip = torch.diag(torch.tensor([1.0, 1.0, -1.0]))

    def turned(axis: torch.Tensor, rate: float, keyframe: PosedObservation) -> Pose:
        angle = min(rate * (keyframe.observation.index - 3), 60.0)
        return from_matrix(rotation_about(axis, angle) @ first.R, keyframe.pose.translation)

    expected = [[first for _ in frames]]
    expected.append(
        [from_matrix(flip @ f.pose.R @ first.R.T @ flip @ first.R, f.pose.translation) for f in frames]
    )
    for direction in range(DIRECTIONS):
        angle = 2 * math.pi * direction / DIRECTIONS
        axis = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        expected += [[turned(axis, rate, keyframe) for keyframe in frames] for rate in RATES]
    for start, poses in zip(hypotheses(state, frames), expected, strict=True):
        torch.testing.assert_close(start.poses.R, torch.stack([pose.R for pose in poses]))


def test_the_answer_is_the_best_of_what_was_tried_and_keeps_the_gauge(waiting):
    state, frames = waiting
    solver = quick_solver("rerendering", solver={"init_iterations": 4}).config.solver
    optimum = initialize_jointly(state, frames, solver, tau=0.2)
    assert optimum.reason == ""
    assert len(optimum.parameters.translation) == len(frames)
    torch.testing.assert_close(optimum.parameters.translation[0], frames[0].pose.translation)
    assert degrees(optimum.parameters, 0, frames[0].pose) < 0.01
    # All hypotheses for a third, the best few for the whole number of iterations.
    assert optimum.iterations > len(hypotheses(state, frames)) + 4


def test_the_direction_of_the_turn_is_found(waiting):
    state, frames = waiting
    solver = quick_solver("rerendering", solver={"init_iterations": 30}).config.solver
    poses = initialize_jointly(state, frames, solver, tau=0.2).parameters.poses
    found = np.stack([poses[n].matrix().numpy()[:3, :3] for n in range(len(frames))])
    errors = aligned_rotation_errors(found, short_clip().T_cam_obj[: len(frames), :3, :3])
    assert np.median(errors) < 4
