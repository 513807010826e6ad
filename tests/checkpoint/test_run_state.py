"""When the state of a run is saved: after every tenth step, and whenever an older state would be of no use."""

from __future__ import annotations

import pytest

from tracking3d.results.checkpoint.folder import Checkpoint
from tracking3d.results.checkpoint.progress import JournalEntry
from tracking3d.results.checkpoint.run_state import SAVED_EVERY, RunState


@pytest.fixture
def folder(tmp_path):
    return tmp_path


def steps(state: RunState, count: int, first: int = 0, **changes) -> list[int]:
    """Take steps; the frames after which the state on disk is a new one."""
    saved = []
    for index in range(first, first + count):
        state.advance({"frame": index}, JournalEntry(index, 0), last=index, **changes)
        if Checkpoint(state.checkpoint._folder.parent, ()).read().session["frame"] == index:
            saved.append(index)
    return saved


def read(folder) -> tuple[int, int, list[int]]:
    """Of the state on disk: the session's frame, the last frame, and the frames that were taken."""
    kept = Checkpoint(folder, ()).read()
    return kept.session["frame"], kept.progress.last, list(kept.taken)


def test_it_is_saved_after_the_first_step_and_every_tenth_one(folder):
    assert steps(RunState(Checkpoint(folder, ())), 25) == [0, SAVED_EVERY, 2 * SAVED_EVERY]
    assert read(folder) == (20, 20, list(range(21)))


def test_a_run_that_is_stopped_saves_its_last_step(folder):
    state = RunState(Checkpoint(folder, ()))
    steps(state, 15)
    state.save()
    assert read(folder) == (14, 14, list(range(15)))
    before = (folder / ".state" / "state.json").stat().st_mtime_ns
    state.save()  # nothing is new
    assert (folder / ".state" / "state.json").stat().st_mtime_ns == before


def test_rollback_points_are_saved_between(folder):
    assert steps(RunState(Checkpoint(folder, (), rollback_points=8)), 13) == [0, 3, 7, 10, 11]


def test_it_is_saved_at_once_when_earlier_frames_have_other_estimates(folder):
    state = RunState(Checkpoint(folder, ()))
    steps(state, 3)
    assert read(folder)[0] == 0
    state.advance({"frame": 3}, JournalEntry(3, 0), revised=[0, 1], last=3)
    assert read(folder) == (3, 3, [0, 1, 2, 3])
    assert steps(state, 5, first=4) == []


def test_without_a_checkpoint_only_the_progress_is_kept():
    state = RunState()
    state.advance({"frame": 0}, JournalEntry(0, 0), last=7)
    state.save()
    assert state.progress.last == 7
