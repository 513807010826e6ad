"""When what moves along beside the object is asked, and when it may be new of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from online_runs import FRAMES, known_run
from solid_points import map_with_points

from tracking3d.estimation.online import moving
from tracking3d.estimation.online.answer_mask import finer, seen_through
from tracking3d.estimation.online.moving import moving_beside, seen_again, with_past

IMAGE = np.zeros((120, 160), np.uint8)


@pytest.fixture
def state(monkeypatch):
    """A belief of a box that turns; everything moves along."""
    belief = known_run(FRAMES)[0]  # other tests have the same run: it is solved before anything is replaced
    monkeypatch.setattr(
        moving, "moves_along", lambda here, earlier, window, *object_: np.ones((window.size,) * 2, np.float32)
    )
    return belief


def found(state, mask=None, witnesses=moving._WITNESSES, lost=False) -> SimpleNamespace:
    """The last keyframe found where it is."""
    view = state.known.keyframes[-1]
    view = replace(view, mask=view.mask if mask is None else mask)
    return SimpleNamespace(
        view=view,
        lost=lost,
        support=SimpleNamespace(witnesses=witnesses),
        fit=SimpleNamespace(pose=view.pose),
    )


def test_a_pose_that_points_agree_with_tells_what_moves_along(state):
    assert state.past
    assert (moving_beside(state, found(state), IMAGE) == 1).all()


def test_others_do_not(state):
    assert moving_beside(state, found(state, lost=True), IMAGE) is None
    assert moving_beside(state, found(state, witnesses=moving._WITNESSES - 1), IMAGE) is None
    assert moving_beside(replace(state, past=()), found(state), IMAGE) is None


def test_nothing_is_asked_at_the_border_and_of_a_still_scene(state):
    cut_off = np.zeros(IMAGE.shape, bool)
    cut_off[40:80, 120:] = True
    assert moving_beside(state, found(state, cut_off), IMAGE) is None
    still = replace(state.known, beside=np.full((8, 2), 9))
    assert moving_beside(replace(state, known=still), found(state), IMAGE) is None


def test_of_a_side_that_comes_again_nothing_beside_is_new(state, monkeypatch):
    monkeypatch.setattr(moving, "seen_again", lambda known, pose: True)
    seen = found(state)
    told = moving_beside(state, seen, IMAGE)
    window, _ = finer(seen.view.observation)
    inside = seen_through(seen.view.mask | state.known.silhouette(seen.view.pose, state.camera), window)
    assert (told[inside] == 1).all() and (told[~inside] == 0).all()


def test_frames_are_remembered_while_they_are_believed(state):
    answer = known_run(FRAMES)[1][-1]
    after = with_past(state, answer, found(state), IMAGE)
    assert after.past[:-1] == state.past[-moving._MOST + 1 :]
    assert with_past(state, answer, found(state, witnesses=0), IMAGE) is state
    assert not with_past(state, answer, found(state, lost=True), IMAGE).past


@pytest.mark.parametrize(
    ("shown", "turned_to", "again"),
    [
        ([0.0, 20.0, 40.0], 0, True),  # it has turned away by 40 degrees and is back
        ([0.0, 20.0, 40.0], 1, False),  # 20 degrees away only
        ([0.0, 20.0, 40.0], 2, False),  # where it is now
        ([0.0, 10.0, 20.0], 0, False),
        ([0.0, 60.0, 0.0], 2, True),
    ],
)
def test_a_side_that_was_seen_before_it_turned_away_has_nothing_new(shown, turned_to, again):
    known = map_with_points(shown)
    assert seen_again(known, known.keyframes[turned_to].pose) is again
