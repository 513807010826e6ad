"""Frames that waited for the first map are estimated with it, and those that show something new extend it."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from online_runs import Run, estimate_of, final
from online_runs import solver as small_solver

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.online import initializer
from tracking3d.estimation.online.initialization.initial_map import InitialMap
from tracking3d.estimation.online.initialization.pending_frames import try_initialize
from tracking3d.estimation.online.solver import OnlineSolver
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.frames import Frame
from tracking3d.geometry.pose import Pose, pose_from_arrays
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

FRAMES, SOLVED = 20, 6
"""Frames of the clip, and those that the first map is made from, although all of them wait."""


@cache
def clip() -> SyntheticClip:
    """A box with cut corners that turns by 114 degrees: the last frame shows other sides than the first."""
    return synthesize(
        SyntheticSpec(frames=FRAMES, size=(160, 120), degrees_per_frame=6.0, drift=(0.2, -0.1, 0.2))
    )


@pytest.fixture
def late_start(monkeypatch):
    """The first map is made when the last frame has come, from the first few frames alone."""

    def wait(
        state: SolverState, config: OnlineConfig, ended: bool = False
    ) -> tuple[SolverState, InitialMap | None]:
        if len(state.pending) < FRAMES:
            return state, None
        _, start = try_initialize(replace(state, pending=state.pending[:SOLVED]), config, ended=True)
        return state, start

    monkeypatch.setattr(initializer, "try_initialize", wait)


def run_to(last: int, solver: OnlineSolver) -> Run:
    """The state and the estimates after the frames up to one."""
    given = [(Frame(i, clip().images[i]), estimate_of(clip().masks[i])) for i in range(last + 1)]
    state, estimate = solver.init(*given[0])
    estimates = [estimate]
    for frame, mask in given[1:]:
        state, estimate = solver.step(state, frame, mask)
        estimates.append(estimate)
    return state, estimates


def run_clip() -> Run:
    """The state at the end, and the final causal estimates."""
    state, estimates = run_to(FRAMES - 1, small_solver())
    return state, final(estimates)


def largest_error(estimates) -> float:
    """Degrees of the worst rotation."""
    found = np.stack([estimate.T_cam_obj[:3, :3] for estimate in estimates])
    true = clip().T_cam_obj[[estimate.index for estimate in estimates], :3, :3]
    return float(aligned_rotation_errors(found, true).max())


@pytest.mark.usefixtures("late_start")
def test_frames_after_those_of_the_start_become_keyframes_and_their_points_landmarks():
    state, estimates = run_clip()
    indices = [view.index for view in state.object_map.keyframes]
    assert indices == sorted(set(indices))
    assert indices[-1] > FRAMES - 4
    assert estimates[-1].diagnostics["inliers"] > 10
    assert largest_error(estimates) < 25
    assert state.feature_space.contrast == 0  # with points the features are the encoder's alone


def test_frames_before_those_of_the_start_are_estimated_backwards_in_time(monkeypatch):
    skipped = 5

    def wait(
        state: SolverState, config: OnlineConfig, ended: bool = False
    ) -> tuple[SolverState, InitialMap | None]:
        if len(state.pending) < skipped + SOLVED:
            return state, None
        later = replace(state, rested=state.pending[:skipped], pending=state.pending[skipped:])
        return try_initialize(later, config, ended=True)

    monkeypatch.setattr(initializer, "try_initialize", wait)
    state, estimates = run_clip()
    assert [estimate.index for estimate in estimates] == list(range(FRAMES))
    assert state.object_map.keyframes[0].index == skipped
    assert largest_error(estimates) < 8


@pytest.mark.usefixtures("late_start")
def test_without_them_the_last_frame_shows_hardly_a_landmark(monkeypatch):
    """The object turns far enough for the test above to fail if nothing is inserted."""
    monkeypatch.setattr(initializer, "_is_new", lambda *_: False)
    state, estimates = run_clip()
    assert state.object_map.keyframes[-1].index == SOLVED - 1
    assert estimates[-1].diagnostics["inliers"] < 5


AGAIN = 16
"""The frame before which a plain map is restarted."""


@pytest.fixture
def plain_map(monkeypatch) -> None:
    """The first map counts as one without points, and its restart finds the true rotations."""

    def without_points(*given, **options) -> tuple[SolverState, InitialMap | None]:
        state, start = try_initialize(*given, **options)
        if start is None:
            return state, None
        return state, replace(start, object_map=replace(start.object_map, pointless=True))

    def restarted(state: SolverState, config: OnlineConfig) -> SolverState:
        if state.last_pose[1] + 1 != AGAIN:
            return state
        assert state.revisable
        other = [replace(view, pose=exact(view.index, state)) for view in state.object_map.keyframes]
        return replace(state, object_map=replace(state.object_map, keyframes=tuple(other)), revisable=())

    def exact(index: int, state: SolverState) -> Pose:
        R = clip().T_cam_obj[index, :3, :3] @ clip().T_cam_obj[0, :3, :3].T
        (own,) = (view.pose for view in state.object_map.keyframes if view.index == index)
        return pose_from_arrays(R, own.translation.numpy(), state.object_map.vertices)

    monkeypatch.setattr(initializer, "try_initialize", without_points)
    monkeypatch.setattr(initializer, "restart_if_misfit", restarted)


@pytest.mark.usefixtures("plain_map")
def test_earlier_frames_get_the_poses_of_a_map_that_is_restarted():
    state, answers = run_to(AGAIN + 1, small_solver())
    at_once, *later = answers[AGAIN:]
    assert [one.index for one in at_once.revised] == list(range(AGAIN))
    assert all(one.probability is None for one in at_once.revised), "of all at once they take much memory"
    assert all(not one.revised for one in later)
    assert state.revisable == ()
    # Without points all keyframes have the contrast among their features, also those that came after the start.
    assert state.feature_space.contrast > 0
    assert {len(view.observation.features) for view in state.object_map.keyframes} == {4}
    assert state.surface.texture.shape[0] == 4
    assert largest_error(final(answers[AGAIN : AGAIN + 1])) < 10


@pytest.mark.usefixtures("plain_map")
def test_a_live_source_does_not_wait_for_a_restarted_map(monkeypatch):
    restart, released, asked = initializer.restart_if_misfit, threading.Event(), []

    def held(state: SolverState, config: OnlineConfig) -> SolverState:
        asked.append(state.last_pose[1])
        assert released.wait(120)
        return restart(state, config)

    def due(state: SolverState) -> bool:
        return state.last_pose[1] + 1 == AGAIN

    monkeypatch.setattr(initializer, "restart_if_misfit", held)
    monkeypatch.setattr(initializer, "needs_restart", due)
    monkeypatch.setattr(initializer, "_FIRST_WAIT", 120.0)  # the first map is not what is tested
    solver = small_solver().for_live_source()
    state, answers = run_to(AGAIN + 2, solver)
    assert asked == [AGAIN - 1]
    assert state.background is not None
    assert not any(one.revised for one in answers[AGAIN:])
    released.set()
    state, late = solver.finish_background_work(state)
    assert state.background is None
    known = [*(one.index for one in late.revised), late.index]
    assert known[:AGAIN] == list(range(AGAIN))
    assert known[-1] == state.last_pose[1] == AGAIN + 2
    assert largest_error(late.revised[:AGAIN]) < 10
