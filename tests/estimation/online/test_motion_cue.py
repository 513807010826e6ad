"""When what moves along beside the object is asked, and when it may be new of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from online_runs import FRAMES, known_run
from solid_points import map_with_points

from tracking3d.estimation.online import masks
from tracking3d.estimation.online.masks import (
    is_seen_again,
    mask_in_window,
    motion_cue_in_window,
    remember_motion,
    upsampled_window,
)

IMAGE = np.zeros((120, 160), np.uint8)


@pytest.fixture
def state(monkeypatch):
    """A belief of a box that turns; everything moves along."""
    updated = known_run(FRAMES)[0]  # other tests have the same run: it is solved before anything is replaced
    monkeypatch.setattr(
        masks,
        "online_motion_log_odds",
        lambda here, earlier, window, *object_: np.ones((window.size,) * 2, np.float32),
    )
    return updated


def found(state, mask=None, inliers=masks._MIN_INLIERS, lost=False) -> SimpleNamespace:
    """The last keyframe found where it is."""
    view = state.object_map.keyframes[-1]
    view = replace(view, mask=view.mask if mask is None else mask)
    return SimpleNamespace(
        view=view,
        lost=lost,
        evidence=SimpleNamespace(inliers=inliers),
        fit=SimpleNamespace(pose=view.pose),
    )


def test_a_pose_that_points_agree_with_tells_what_moves_along(state):
    assert state.motion_references
    assert (motion_cue_in_window(state, found(state), IMAGE) == 1).all()


def test_others_do_not(state):
    assert motion_cue_in_window(state, found(state, lost=True), IMAGE) is None
    assert motion_cue_in_window(state, found(state, inliers=masks._MIN_INLIERS - 1), IMAGE) is None
    assert motion_cue_in_window(replace(state, motion_references=()), found(state), IMAGE) is None


def test_nothing_is_asked_at_the_border_and_of_a_still_scene(state):
    cut_off = np.zeros(IMAGE.shape, bool)
    cut_off[40:80, 120:] = True
    assert motion_cue_in_window(state, found(state, cut_off), IMAGE) is None
    still = replace(state.object_map, candidates_around=np.full((8, 2), 9))
    assert motion_cue_in_window(replace(state, object_map=still), found(state), IMAGE) is None


def test_of_a_side_that_comes_again_nothing_beside_is_new(state, monkeypatch):
    monkeypatch.setattr(masks, "is_seen_again", lambda object_map, pose: True)
    seen = found(state)
    told = motion_cue_in_window(state, seen, IMAGE)
    window, _, _ = upsampled_window(seen.view.observation)
    inside = mask_in_window(
        seen.view.mask | state.object_map.silhouette(seen.view.pose, state.camera), window
    )
    assert (told[inside] == 1).all() and (told[~inside] == 0).all()


def test_frames_are_remembered_while_they_are_believed(state):
    estimate = known_run(FRAMES)[1][-1]
    after = remember_motion(state, estimate, found(state), IMAGE)
    assert after.motion_references[:-1] == state.motion_references[-masks._MAX_REFERENCES + 1 :]
    assert remember_motion(state, estimate, found(state, inliers=0), IMAGE) is state
    assert not remember_motion(state, estimate, found(state, lost=True), IMAGE).motion_references


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
    object_map = map_with_points(shown)
    assert is_seen_again(object_map, object_map.keyframes[turned_to].pose) is again
