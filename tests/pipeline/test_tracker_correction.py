"""With ``solver.tracker_feedback`` a sure answer is handed back to the mask tracker, and nothing else is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import BaseModel
from refining_solver import CausalSolver

from tracking3d import Frame, FrameEstimate, Status, load_config, track
from tracking3d.errors import PluginError
from tracking3d.estimation.estimate import MOTION_RATIO, MOVES, RELOCALIZED, SURE, WORTH_CORRECTING, corrects
from tracking3d.frames import MaskEstimate, Prompt
from tracking3d.pipeline.session import SOLVERS
from tracking3d.plugins import VARIABLE
from tracking3d.trackers.precomputed import PrecomputedMasks
from tracking3d.trackers.protocol import CorrectableTracker

SIZE = (40, 50)


class Correctable:
    """Answers with its last mask; remembers what it was corrected with. Fails in the frames ``at``."""

    class Options(BaseModel):
        at: tuple[int, ...] = ()

    @classmethod
    def from_options(cls, options: Options) -> Correctable:
        tracker = cls()
        tracker.at, tracker.corrections = options.at, {}
        BUILT.append(tracker)
        return tracker

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        self.mask = prompt.mask.astype(np.float32)
        return MaskEstimate(self.mask)

    def step(self, frame: Frame) -> MaskEstimate:
        return MaskEstimate(self.mask)

    def correct(self, frame: Frame, mask: np.ndarray) -> None:
        if frame.index in self.at:
            raise ZeroDivisionError("no weights")
        self.corrections[frame.index] = mask.copy()
        mask[:] = False  # its own copy


class NotCorrectable(Correctable):
    correct = None


BUILT: list[Correctable] = []


def square(left: int, width: int = 20) -> np.ndarray:
    mask = np.zeros(SIZE, dtype=bool)
    mask[10:30, left : left + width] = True
    return mask


def estimate(**changes) -> FrameEstimate:
    """The initial mask is 20 pixels wide, the answer 25: an IoU of 0.8."""
    plain = FrameEstimate(1, None, np.eye(4), square(10, 25), square(10), Status.TRACKED, "", 0.9)
    return replace(plain, **changes)


class SureSolver(CausalSolver):
    """Answers with a mask a quarter wider than the initial one."""

    def _answer(self, frame, mask):
        binary = mask.binary
        return replace(super()._answer(frame, mask), mask=binary | np.roll(binary, 5, 1), **CHANGES)


CHANGES: dict = {}


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(SOLVERS, "online", SureSolver)
    here = Path(__file__)
    monkeypatch.setenv(
        VARIABLE,
        f"tracking3d.trackers:good={here}:Correctable;tracking3d.trackers:plain={here}:NotCorrectable",
    )


def test_a_sure_answer_that_differs_somewhat_corrects():
    assert corrects(estimate())
    assert corrects(estimate(confidence=SURE))


@pytest.mark.parametrize(
    "changes",
    [
        {"status": Status.UNCERTAIN},
        {"status": Status.LOST},
        {"confidence": SURE - 0.01},
        {"confidence": float("nan")},
        {"initial_mask": None},
        {"mask": square(10)},
        {"mask": square(10, 10) & square(15, 10)},
        {"mask": np.zeros(SIZE, bool)},
        {"mask": np.zeros(SIZE, bool), "initial_mask": np.zeros(SIZE, bool)},
    ],
    ids=["uncertain", "lost", "unsure", "nan", "no mask", "same", "a quarter", "empty", "both empty"],
)
def test_others_do_not(changes):
    assert not corrects(estimate(**changes))


def test_the_bounds_themselves_are_worth_correcting():
    assert WORTH_CORRECTING == (0.5, 0.9)
    assert corrects(estimate(mask=square(10, 10)))  # half of it
    assert corrects(estimate(mask=square(10, 18)))  # 18 of 20
    assert not corrects(estimate(mask=square(10, 9)))


def test_what_moves_along_corrects_however_unsure_the_pose_is():
    unsure = {"confidence": 0.3, "status": Status.UNCERTAIN}
    assert corrects(estimate(diagnostics={MOTION_RATIO: MOVES}, **unsure))
    assert corrects(estimate(diagnostics={MOTION_RATIO: 0.05}, mask=square(10, 19), **unsure))  # 19 of 20
    assert not corrects(estimate(diagnostics={MOTION_RATIO: MOVES / 2}, **unsure))
    assert not corrects(estimate(diagnostics={MOTION_RATIO: 0.5}, mask=square(10, 9), **unsure))
    assert not corrects(estimate(diagnostics={MOTION_RATIO: 0.5}, mask=np.zeros(SIZE, bool), **unsure))


def test_what_was_found_elsewhere_by_its_points_corrects_a_mask_of_something_else():
    for initial in (None, square(0, 5), square(35, 10)):
        assert corrects(estimate(hypothesis=RELOCALIZED, initial_mask=initial, confidence=0.4))
    for initial in (square(10), square(12)):  # the mask is there, too: then the usual bounds hold
        assert not corrects(estimate(hypothesis=RELOCALIZED, initial_mask=initial, confidence=0.4))
    assert not corrects(estimate(hypothesis=RELOCALIZED, status=Status.UNCERTAIN))


def answers(tracker: dict | str, correct: bool = True, policy: str = "continue", **changes) -> list:
    BUILT.clear()
    CHANGES.clear()
    CHANGES.update({"status": Status.TRACKED, "confidence": 0.9} | changes)
    config = load_config(
        overrides=[f"solver.tracker_feedback={str(correct).lower()}"],
        tracker=tracker,
        runtime={"on_plugin_failure": policy},
    )
    images = np.zeros((4, *SIZE, 3), np.uint8)
    return list(track(images, mask=square(10), config=config))


def loaded(name: str) -> list:
    """The trackers that were built: plug-ins are loaded as a module of their own."""
    from tracking3d.plugins import TRACKERS, load_plugin

    return load_plugin(TRACKERS, name).from_options.__globals__["BUILT"]


def test_the_tracker_is_handed_the_answer_of_every_later_frame():
    loaded("good").clear()
    given = answers("good")
    [tracker] = loaded("good")
    assert list(tracker.corrections) == [1, 2, 3]  # the first frame's mask was given by the user
    for index, mask in tracker.corrections.items():
        np.testing.assert_array_equal(mask, square(10, 25))
        assert given[index].mask.any()  # what a tracker does to its copy is its own affair
        assert given[index].failure == ""


@pytest.mark.parametrize(
    "changes", [{"correct": False}, {"status": Status.UNCERTAIN}, {"confidence": SURE - 0.1}]
)
def test_it_is_left_alone_where_that_is_not_wanted_or_not_sure(changes):
    loaded("good").clear()
    answers("good", **changes)
    [tracker] = loaded("good")
    assert tracker.corrections == {}


def test_a_tracker_that_cannot_be_corrected_is_not():
    assert [answer.failure for answer in answers("plain")] == [""] * 4


def test_precomputed_masks_cannot_be_corrected():
    assert not issubclass(PrecomputedMasks, CorrectableTracker)


def test_a_tracker_that_fails_at_it_is_recorded_like_any_failure():
    given = answers({"name": "good", "at": [2]})
    assert "no weights" in given[2].failure
    assert given[2].status is Status.UNCERTAIN
    assert [bool(answer.failure) for answer in given] == [False, False, True, False]
    with pytest.raises(PluginError, match="failed at frame 2: ZeroDivisionError: no weights"):
        answers({"name": "good", "at": [2]}, policy="stop")


def test_the_papers_setting_never_corrects():
    assert load_config(preset="paper").solver.tracker_feedback is False
