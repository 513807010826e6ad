"""Frames that waited for the first map are estimated with it, and those that show something new extend it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from online_runs import Run, estimate_of, final
from online_runs import solver as small_solver

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online import first_estimates, map_initialization
from tracking3d.estimation.online.initialization.initial_map import InitialMap
from tracking3d.estimation.online.initialization.initializer import try_initialize
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.frames import Frame
from tracking3d.synthesis.convex_clips import SyntheticClip, SyntheticSpec, synthesize
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
        assert state.pending is not None
        if len(state.pending) < FRAMES:
            return state, None
        _, start = try_initialize(replace(state, pending=state.pending[:SOLVED]), config, ended=True)
        return state, start

    monkeypatch.setattr(map_initialization, "try_initialize", wait)


def run_clip() -> Run:
    """The state at the end, and the final causal estimates."""
    frames = [Frame(index, image) for index, image in enumerate(clip().images)]
    masks = [estimate_of(mask) for mask in clip().masks]
    state, estimate = small_solver().init(frames[0], masks[0])
    estimates = [estimate]
    for frame, mask in zip(frames[1:], masks[1:], strict=True):
        state, estimate = small_solver().step(state, frame, mask)
        estimates.append(estimate)
    return state, final(estimates)


def largest_error(estimates) -> float:
    """Degrees of the worst rotation."""
    found = np.stack([estimate.T_cam_obj[:3, :3] for estimate in estimates])
    return float(aligned_rotation_errors(found, clip().T_cam_obj[:, :3, :3]).max())


@pytest.mark.usefixtures("late_start")
def test_frames_after_those_of_the_start_become_keyframes_and_their_points_landmarks():
    state, estimates = run_clip()
    indices = [view.index for view in state.object_map.keyframes]
    assert indices == sorted(set(indices))
    assert indices[-1] > FRAMES - 4
    assert estimates[-1].diagnostics["inliers"] > 10
    assert largest_error(estimates) < 25


def test_frames_before_those_of_the_start_are_estimated_backwards_in_time(monkeypatch):
    skipped = 5

    def wait(
        state: SolverState, config: OnlineConfig, ended: bool = False
    ) -> tuple[SolverState, InitialMap | None]:
        assert state.pending is not None
        if len(state.pending) < skipped + SOLVED:
            return state, None
        later = replace(state, rested=state.pending[:skipped], pending=state.pending[skipped:])
        return try_initialize(later, config, ended=True)

    monkeypatch.setattr(map_initialization, "try_initialize", wait)
    state, estimates = run_clip()
    assert state.rested == ()
    assert [estimate.index for estimate in estimates] == list(range(FRAMES))
    assert state.object_map.keyframes[0].index == skipped
    assert largest_error(estimates) < 8


@pytest.mark.usefixtures("late_start")
def test_without_them_the_last_frame_shows_hardly_a_landmark(monkeypatch):
    """The object turns far enough for the test above to fail if nothing is inserted."""
    monkeypatch.setattr(first_estimates, "_is_new", lambda *_: False)
    state, estimates = run_clip()
    assert state.object_map.keyframes[-1].index == SOLVED - 1
    assert estimates[-1].diagnostics["inliers"] < 5
