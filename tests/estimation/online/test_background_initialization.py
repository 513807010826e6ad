"""For a live source the first map is computed in another thread; frames go on, and are caught up with."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from online_runs import FRAMES, Run, estimate_of, final, frame, rotation_errors, true_mask
from online_runs import solver as waiting_solver

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.estimate import FrameEstimate, Status
from tracking3d.estimation.online import initializer
from tracking3d.estimation.online.initialization.initial_map import InitialMap
from tracking3d.estimation.online.initialization.pending_frames import try_initialize
from tracking3d.estimation.online.state.solver_state import Initializing, Mapped, SolverState
from tracking3d.estimation.solver import RefiningSolver
from tracking3d.pipeline.session import Session
from tracking3d.runtime.background_attempt import BackgroundAttempt
from tracking3d.trackers.prompts.prompt import make_prompt

is_done = BackgroundAttempt.is_done
PATIENCE = 120.0
"""Seconds until a test fails because a thread hangs."""


@pytest.fixture
def held(monkeypatch) -> Iterator[threading.Event]:
    """A map that is found is not handed out before this is set."""
    released = threading.Event()

    def hold(
        state: SolverState, config: OnlineConfig, ended: bool = False
    ) -> tuple[SolverState, InitialMap | None]:
        state, start = try_initialize(state, config, ended)
        if start is not None:
            assert released.wait(PATIENCE)
        return state, start

    monkeypatch.setattr(initializer, "try_initialize", hold)
    yield released
    released.set()


def solver():
    return waiting_solver().for_live_source()


def take(indices: range, after: Run | None = None) -> Run:
    """The state after some frames with true masks, and their estimates."""
    state, estimates = (after[0], list(after[1])) if after else (None, list[FrameEstimate]())
    for index in indices:
        given = frame(index), estimate_of(true_mask(index))
        state, estimate = solver().init(*given) if state is None else solver().step(state, *given)
        estimates.append(estimate)
    assert state is not None
    return state, estimates


def begun_run(frames: int) -> Run:
    """The first frames, in which a map is begun and not finished."""
    run = take(range(1))
    for index in range(1, frames):
        run = take(range(index, index + 1), run)
        begun = run[0].background
        if begun is not None and "computed" not in run[1][-1].reason:
            assert begun.is_done(PATIENCE)
    return run


def test_it_is_a_solver_for_live_sources():
    assert isinstance(waiting_solver(), RefiningSolver)
    assert solver().in_background and not waiting_solver().in_background


def test_frames_keep_their_initial_masks_while_the_map_is_computed(held):
    state, estimates = begun_run(9)
    assert isinstance(state, Initializing) and state.background is not None
    for estimate in estimates[1:]:
        assert estimate.status is Status.UNCERTAIN and not estimate.revised
        np.testing.assert_array_equal(estimate.mask, true_mask(estimate.index))
    assert estimates[-1].reason == "the first map is being computed"


def test_the_solver_goes_on_with_the_map_when_it_has_caught_up(held):
    state, estimates = begun_run(9)
    begun = state.background
    assert begun is not None
    held.set()
    assert begun.is_done(PATIENCE)
    state, estimates = take(range(9, FRAMES), (state, estimates))
    assert isinstance(state, Mapped) and not state.lost
    adopted = estimates[9]
    known = [*(one.index for one in adopted.revised), adopted.index]
    assert known == sorted(set(known)) and known[0] == 0 and known[-1] == 9
    assert all(one.status is not Status.LOST for one in (*adopted.revised, *estimates[9:]))
    assert estimates[-1].status is Status.TRACKED
    tracked = [one for one in final(estimates) if one.status is Status.TRACKED]
    assert rotation_errors(tracked).mean() < 2


def test_the_end_waits_for_the_map(held):
    state, _ = begun_run(9)
    held.set()
    finished, found = solver().finish_background_work(state)
    assert found is not None
    known = [*(one.index for one in found.revised), found.index]
    assert known == sorted(set(known)) and (known[0], known[-1]) == (0, 8)
    assert isinstance(finished, Mapped) and not finished.lost
    assert len(finished.object_map.keyframes) > 1
    assert finished.last_pose[1] == 8
    assert solver().finish_background_work(finished) == (finished, None)


def test_nothing_is_kept_of_a_quick_attempt_that_finds_nothing(monkeypatch):
    asked = []

    def find_nothing(
        state: SolverState, config: OnlineConfig, ended: bool = False
    ) -> tuple[SolverState, InitialMap | None]:
        asked.append(len(state.pending))
        return replace(state, waiting_reason="for a reason", next_attempt=0.5), None

    monkeypatch.setattr(initializer, "try_initialize", find_nothing)
    monkeypatch.setattr(initializer, "_FIRST_WAIT", PATIENCE)
    state, estimates = take(range(4))
    assert asked == [2, 3, 4]
    assert state.background is None and len(state.pending) == 4
    assert state.next_attempt == 0.5 and estimates[-1].reason == "for a reason"


def test_frames_that_come_during_an_attempt_in_vain_are_kept(monkeypatch):
    released = threading.Event()

    def find_nothing_late(
        state: SolverState, config: OnlineConfig, ended: bool = False
    ) -> tuple[SolverState, InitialMap | None]:
        assert released.wait(PATIENCE)
        return replace(state, pending=state.pending[1:]), None

    monkeypatch.setattr(initializer, "try_initialize", find_nothing_late)
    state, estimates = take(range(5))
    begun = state.background
    assert begun is not None
    released.set()
    assert begun.is_done(PATIENCE)
    state, _ = take(range(5, 6), (state, estimates))
    waiting = [view.index for view, _ in state.pending]
    assert waiting == [1, 2, 3, 4, 5], "the first frame was given up by the attempt"


def test_an_error_in_the_other_thread_is_raised_in_the_next_frame(monkeypatch):
    def fail(state: SolverState, config: OnlineConfig, ended: bool = False) -> None:
        raise ValueError("something is wrong")

    monkeypatch.setattr(initializer, "try_initialize", fail)
    monkeypatch.setattr(initializer, "_FIRST_WAIT", PATIENCE)
    with pytest.raises(ValueError, match="something is wrong"):
        take(range(2))


def test_the_estimates_of_a_map_that_comes_after_the_last_frame_are_given_at_the_end(held):
    session = Session(waiting_solver().config, make_prompt(frame(0), mask=true_mask(0)), live=True)
    estimates = [session.step(frame(index)) for index in range(9)]
    held.set()
    assert not any(estimate.revised for estimate in estimates)
    late = [one.index for one in session.finish_background_work()]
    assert late == sorted(set(late)) and (late[0], late[-1]) == (0, 8)
    assert session.finish_background_work() == []


@pytest.mark.parametrize("live", [False, True])
def test_a_session_of_a_live_source_uses_it(held, live):
    if not live:
        held.set()
    session = Session(waiting_solver().config, make_prompt(frame(0), mask=true_mask(0)), live=live)
    reasons = [session.step(frame(index)).reason for index in range(9)]
    held.set()
    assert bool(session.finish_background_work()) is live
    assert any("being computed" in reason for reason in reasons) is live


def test_after_an_error_there_is_still_an_object_made_of_the_pending_frames(monkeypatch):
    run = take(range(1))

    def fail(state: SolverState, config: OnlineConfig, ended: bool = False) -> None:
        raise ValueError("something is wrong")

    monkeypatch.setattr(initializer, "try_initialize", fail)
    monkeypatch.setattr(initializer, "_FIRST_WAIT", 0.0)
    state, _ = run
    monkeypatch.setattr(
        BackgroundAttempt, "is_done", lambda self, wait=0.0: wait is None and is_done(self, wait)
    )
    state, _ = solver().step(state, frame(1), estimate_of(true_mask(1)))
    assert state.background is not None
    assert len(solver().result(state).vertices) > 0
