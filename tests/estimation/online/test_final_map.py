"""A final refinement is taken only where it re-renders the keyframes better than what there was.

A map without points is fitted to keyframes from all of the video before that.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
import trimesh
from turned_solid import CAMERA, degrees_apart, turned_map

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.online.initialization.initial_map import lead_over_rivals, reverse_rotations
from tracking3d.estimation.online.mapping import global_refinement
from tracking3d.estimation.online.mapping.global_refinement import (
    keyframe_cost,
    refine_globally,
    refit_without_points,
)
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about

ANGLES = [0.0, 12.0, 24.0, 36.0]


def spoilt(object_map, degrees: float):
    """The keyframes but the first are turned by so much, and their textures go along."""
    keyframes = [object_map.keyframes[0]]
    for view in object_map.keyframes[1:]:
        turn = rotation_about(view.pose.translation.new_tensor([0.0, 0.0, 1.0]), degrees)
        pose: Pose = from_matrix(turn @ view.pose.R, view.pose.translation)
        view = replace(view, pose=pose)
        keyframes.append(replace(view, texture=object_map.back_project(view.observation.features, view)))
    return replace(object_map, keyframes=tuple(keyframes))


@pytest.fixture(scope="module")
def object_map():
    return spoilt(turned_map(ANGLES), 0.0)


def test_what_is_spoilt_explains_the_keyframes_worse_and_the_more_the_worse(object_map):
    costs = [keyframe_cost(spoilt(object_map, degrees)) for degrees in (0.0, 3.0, 8.0)]
    assert costs == sorted(costs) and costs[0] < 0.8 * costs[1]


def test_a_refinement_that_spoils_the_map_is_not_taken(object_map, monkeypatch):
    monkeypatch.setattr(global_refinement, "refine_local_map", lambda one, *_, **__: spoilt(one, 5.0))
    kept, camera = refine_globally(object_map, CAMERA, OnlineConfig())
    assert kept is object_map and camera is CAMERA


def test_one_that_mends_it_is(object_map, monkeypatch):
    monkeypatch.setattr(global_refinement, "refine_local_map", lambda *_, **__: object_map)
    kept, _ = refine_globally(spoilt(object_map, 5.0), CAMERA, OnlineConfig())
    assert kept is object_map


@pytest.mark.parametrize("better", [True, False])
def test_a_solved_lens_is_taken_only_where_the_keyframes_are_explained_better_with_it(
    object_map, monkeypatch, better
):
    assumed, other = replace(CAMERA, assumed=True), replace(CAMERA, fx=2 * CAMERA.fx, assumed=True)
    good, bad = object_map, spoilt(object_map, 5.0)
    asked, solved = (bad, good) if better else (good, bad)
    monkeypatch.setattr(global_refinement, "refine_local_map", lambda one, *_, **__: one)
    monkeypatch.setattr(global_refinement, "solve_lens", lambda *_: (solved, other))
    kept, camera = refine_globally(asked, assumed, OnlineConfig())
    assert kept is good and camera == (other if better else assumed)


def test_a_given_lens_stays(object_map, monkeypatch):
    def solve_lens(*_):
        raise AssertionError("nobody asked")

    monkeypatch.setattr(global_refinement, "refine_local_map", lambda one, *_, **__: one)
    monkeypatch.setattr(global_refinement, "solve_lens", solve_lens)
    assert refine_globally(object_map, CAMERA, OnlineConfig())[1] is CAMERA


def test_a_surface_that_earlier_poses_have_bent_is_fitted_from_the_prototype():
    truth = turned_map([15.0 * n for n in range(10)])
    solid = trimesh.Trimesh(truth.vertices, truth.shape.faces, process=False)

    def distance(vertices):
        return trimesh.proximity.closest_point_naive(solid, vertices.numpy())[1].mean()

    bent = truth.vertices + 0.25 * torch.sin(7 * truth.vertices[:, [1, 2, 0]])
    found = refit_without_points(replace(truth, vertices=bent), FitWeights())
    assert distance(found.vertices) < 0.4 * distance(bent)
    poses = zip(found.keyframes, truth.keyframes, strict=True)
    assert max(degrees_apart(one.pose, true.pose) for one, true in poses) < 8


def test_keyframes_from_all_of_the_video_stay(monkeypatch):
    monkeypatch.setattr(global_refinement, "fit_jointly", lambda one, *_: (one, 1.0))
    found = refit_without_points(turned_map([3.0 * n for n in range(40)]), FitWeights())
    indices = [view.index for view in found.keyframes]
    assert indices[0] == 0 and indices[-1] == 78  # every second frame of them is a keyframe
    assert len(indices) == 16 and max(b - a for a, b in pairwise(indices)) <= 6


def test_right_rotations_lead_and_reversed_ones_do_not():
    truth = turned_map([12.0 * n for n in range(8)])
    views = list(truth.keyframes)
    poses = zip(views, reverse_rotations(views, CAMERA), strict=True)
    reversed_views = tuple(replace(view, pose=pose) for view, pose in poses)
    wrong = replace(truth, vertices=truth.shape.rest, keyframes=reversed_views)
    right, led = (
        lead_over_rivals(refit_without_points(one, FitWeights()), CAMERA, FitWeights())
        for one in (truth, wrong)
    )
    assert right > 0.05 and led < -0.5
