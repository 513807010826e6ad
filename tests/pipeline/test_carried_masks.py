"""A mask tracker is left out of frames in which the solver is sure, and told what became of the object there."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from refining_solver import StandInSolver
from resumable_runs import Stopped, assert_alike, settings, stop_at

from tracking3d.estimation.estimate import CARRIED, Status
from tracking3d.estimation.online.features.klt import FollowedPoints, carry, follow
from tracking3d.pipeline import session
from tracking3d.pipeline.prompted_tracker import PromptedTracker
from tracking3d.pipeline.record import record
from tracking3d.pipeline.session import SOLVERS, Session
from tracking3d.results.checkpoint.progress import read_journal
from tracking3d.results.run_reader import RunReader
from tracking3d.trackers.flow import FlowTracker
from tracking3d.video import open_source

FRAMES = 14


class SureSolver(StandInSolver):
    """Is sure of all frames but those ``in_doubt``; masks move by a pixel."""

    in_doubt: tuple[int, ...] = ()
    taken: list[int]
    moved: list[int]

    def _answer(self, frame, mask):
        status = Status.UNCERTAIN if frame.index in self.in_doubt else Status.TRACKED
        estimate = replace(super()._answer(frame, mask), keyframe=False, mask=mask.binary)
        self.taken.append(frame.index)
        if mask.carried:
            self.moved.append(frame.index)
        return replace(estimate, status=status, confidence=0.95, diagnostics={"inliers": 50.0})

    def carry_mask(self, state, frame, mask):
        return np.roll(mask, 1, axis=1)


@pytest.fixture(autouse=True)
def sure_solver(monkeypatch, stand_in_solver):
    monkeypatch.setitem(SOLVERS, "online", SureSolver)
    monkeypatch.setattr(SureSolver, "in_doubt", ())
    monkeypatch.setattr(SureSolver, "taken", [], raising=False)
    monkeypatch.setattr(SureSolver, "moved", [], raising=False)


def run(clip, images, folder, *overrides: str, resume: bool = False) -> RunReader:
    chosen = settings("solver.final_refine=false", *overrides)
    record(open_source(str(images)), chosen, folder, mask=clip.masks[0], resume=resume)
    return RunReader(folder)


def carried(run: RunReader) -> list[int]:
    return [one.index for one in run.frames if one.diagnostics.get(CARRIED)]


def test_every_second_frame_is_carried_once_two_in_a_row_were_sure(clip, images, tmp_path, monkeypatch):
    shown, told = [], []
    for name, seen in (("step", shown), ("skip", told)):
        method = getattr(FlowTracker, name)

        def noted(self, frame, *mask, method=method, seen=seen):
            seen.append(frame.index)
            return method(self, frame, *mask)

        monkeypatch.setattr(FlowTracker, name, noted)
    made = run(clip, images, tmp_path / "run")
    assert carried(made) == told == SureSolver.moved == [3, 5, 7, 9, 11, 13]
    assert shown == [1, 2, 4, 6, 8, 10, 12]
    for index in told:
        moved = np.roll(made.initial_mask(index - 1), 1, axis=1)
        np.testing.assert_array_equal(made.initial_mask(index), moved)
    assert carried(run(clip, images, tmp_path / "third", "object.mask_interval=3"))[:4] == [3, 4, 6, 7]


def test_a_frame_in_doubt_is_taken_again_with_the_trackers_mask(clip, images, tmp_path, monkeypatch):
    monkeypatch.setattr(SureSolver, "in_doubt", (7,))
    assert carried(run(clip, images, tmp_path / "run")) == [3, 5, 10, 12]
    assert SureSolver.taken.count(7) == 2 and SureSolver.taken.count(8) == 1


@pytest.mark.parametrize("setting", ["object.mask_interval=1", "object.trust_masks=true"])
def test_who_wants_every_mask_gets_them(clip, images, tmp_path, setting):
    assert not carried(run(clip, images, tmp_path / "run", setting))


def test_a_tracker_that_does_not_say_so_is_asked_for_every_frame(clip, images, tmp_path, monkeypatch):
    monkeypatch.delattr(FlowTracker, "skip")
    assert not carried(run(clip, images, tmp_path / "run"))


@pytest.mark.parametrize("frame", [5, 6], ids=["before a carried frame", "after one"])
def test_a_resumed_run_carries_the_same_masks(clip, images, tmp_path, monkeypatch, frame):
    whole = run(clip, images, tmp_path / "whole")
    with monkeypatch.context() as patch, pytest.raises(Stopped):
        stop_at(patch, Session, "step", frame)
        run(clip, images, tmp_path / "run")
    resumed = run(clip, images, tmp_path / "run", resume=True)
    assert carried(resumed) == carried(whole)
    assert_alike(resumed.folder, whole.folder)
    for index in range(FRAMES):
        np.testing.assert_array_equal(resumed.initial_mask(index), whole.initial_mask(index))


def test_a_resumed_mask_tracker_is_corrected_by_what_was_seen_of_the_object(
    clip, images, tmp_path, monkeypatch
):
    given, correct = [], FlowTracker.correct

    def noted(self, frame, mask):
        given.append((frame.index, mask))
        return correct(self, frame, mask)

    def beside_a_hand(self, frame, estimate):
        hand = np.zeros(frame.size, bool)
        hand[:, : frame.size[1] // 2] = True
        return replace(estimate, occluder=hand)

    monkeypatch.setattr(FlowTracker, "correct", noted)
    monkeypatch.setattr(PromptedTracker, "_with_occluder", beside_a_hand)
    monkeypatch.setattr(session, "corrects", lambda estimate: estimate.index == 2)
    with monkeypatch.context() as patch, pytest.raises(Stopped):
        stop_at(patch, Session, "step", 6)
        run(clip, images, tmp_path / "run")
    run(clip, images, tmp_path / "run", resume=True)
    (index, before), (again, after) = given
    assert index == again == 2
    np.testing.assert_array_equal(before, after)


def test_journals_from_before_there_were_carried_masks_are_read():
    taken, _ = read_journal(b'{"index": 3, "picture": 5, "score": 1.0}\n')
    assert not taken[3].carried


def test_a_mask_moves_as_most_points_do():
    random = np.random.default_rng(0)
    noise = cv2.GaussianBlur(random.random((120, 160)), (0, 0), 2.0)
    before = np.uint8(255 * (noise - noise.min()) / np.ptp(noise))
    affine = np.array([[1.02, 0.03, 3.0], [-0.03, 1.02, 5.0]])
    now = cv2.warpAffine(before, affine, (160, 120))
    mask = np.zeros((120, 160), bool)
    mask[40:90, 50:110] = True
    pixel = np.float32(random.uniform((55, 45), (105, 85), (40, 2)))
    points = FollowedPoints(np.arange(40), pixel)
    here = follow(before, now, points)
    moved = carry(mask, points, here)
    expected = cv2.warpAffine(np.float32(mask), affine, (160, 120)) > 0.5
    assert np.count_nonzero(moved & expected) > 0.98 * np.count_nonzero(moved | expected)
    assert carry(mask, points, here.only(np.arange(len(here)) < 5)) is None
