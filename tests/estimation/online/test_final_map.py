"""A final refinement is taken only where it re-renders the keyframes better than what there was."""

from __future__ import annotations

from dataclasses import replace

import pytest
from turned_solid import CAMERA, turned_map

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online import final_refinement
from tracking3d.estimation.online.final_refinement import keyframe_cost, refined_once_more
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about

ANGLES = [0.0, 12.0, 24.0, 36.0]


def spoilt(known, degrees: float):
    """The keyframes but the first are turned by so much, and their textures go along."""
    keyframes = [known.keyframes[0]]
    for view in known.keyframes[1:]:
        turn = rotation_about(view.pose.translation.new_tensor([0.0, 0.0, 1.0]), degrees)
        pose: Pose = from_matrix(turn @ view.pose.R, view.pose.translation)
        view = replace(view, pose=pose)
        keyframes.append(replace(view, texture=known.back_project(view.observation.features, view)))
    return replace(known, keyframes=tuple(keyframes))


@pytest.fixture(scope="module")
def known():
    return spoilt(turned_map(ANGLES), 0.0)


def test_what_is_spoilt_explains_the_keyframes_worse_and_the_more_the_worse(known):
    costs = [keyframe_cost(spoilt(known, degrees)) for degrees in (0.0, 3.0, 8.0)]
    assert costs == sorted(costs) and costs[0] < 0.8 * costs[1]


def test_a_refinement_that_spoils_the_map_is_not_taken(known, monkeypatch):
    monkeypatch.setattr(final_refinement, "refined", lambda one, *_, **__: spoilt(one, 5.0))
    kept, camera = refined_once_more(known, CAMERA, OnlineConfig())
    assert kept is known and camera is CAMERA


def test_one_that_mends_it_is(known, monkeypatch):
    monkeypatch.setattr(final_refinement, "refined", lambda *_, **__: known)
    kept, _ = refined_once_more(spoilt(known, 5.0), CAMERA, OnlineConfig())
    assert kept is known


@pytest.mark.parametrize("better", [True, False])
def test_a_solved_lens_is_taken_only_where_the_keyframes_are_explained_better_with_it(
    known, monkeypatch, better
):
    assumed, other = replace(CAMERA, assumed=True), replace(CAMERA, fx=2 * CAMERA.fx, assumed=True)
    good, bad = known, spoilt(known, 5.0)
    asked, solved = (bad, good) if better else (good, bad)
    monkeypatch.setattr(final_refinement, "refined", lambda one, *_, **__: one)
    monkeypatch.setattr(final_refinement, "solve_lens", lambda *_: (solved, other))
    kept, camera = refined_once_more(asked, assumed, OnlineConfig())
    assert kept is good and camera == (other if better else assumed)


def test_a_given_lens_stays(known, monkeypatch):
    def solve_lens(*_):
        raise AssertionError("nobody asked")

    monkeypatch.setattr(final_refinement, "refined", lambda one, *_, **__: one)
    monkeypatch.setattr(final_refinement, "solve_lens", solve_lens)
    assert refined_once_more(known, CAMERA, OnlineConfig())[1] is CAMERA
