"""One frame's pose against the map: what is predicted, which points agree, and what is searched for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from solid_points import map_with_points, pixels_of
from turned_solid import CAMERA, degrees_apart, turned, turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.optimization.pose_refinement import render_cost
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.pose_tracking import (
    ENOUGH_MATURE,
    count_inliers,
    extrapolate_motion,
    find_inliers,
    fit_pose,
    pixel_scale,
    pose_near,
    pose_of_points,
)
from tracking3d.estimation.online.relocalization import aligned_keyframes, search_rotations
from tracking3d.geometry.pose import Pose

ANGLES = [-10.0, 0.0, 10.0]


@pytest.fixture(scope="module")
def object_map():
    return map_with_points(ANGLES)


@pytest.fixture(scope="module")
def surface():
    return turned_map([-20.0, -10.0, 0.0, 10.0, 20.0]).surface()


def at(degrees: float, x: float = 0.0) -> Pose:
    pose = turned(degrees)
    return Pose(pose.translation + torch.tensor([x, 0.0, 0.0]), pose.quaternion)


def test_an_unseen_object_moves_on_as_it_did():
    pose = extrapolate_motion(((at(0), 0), (at(10, 0.2), 4)), 6)
    assert degrees_apart(pose, turned(15)) < 0.1
    assert float(pose.translation[0]) == pytest.approx(0.3)


def test_it_does_not_move_on_for_ever():
    trail = ((at(0), 0), (at(2), 1))
    assert degrees_apart(extrapolate_motion(trail, 13), turned(26)) < 0.1
    assert degrees_apart(extrapolate_motion(trail, 1000), turned(26)) < 0.1


def test_without_motion_it_stays():
    pose = at(7, 0.1)
    assert extrapolate_motion(((pose, 3),), 9) is pose


def test_tolerances_grow_with_large_objects_only(object_map):
    view = object_map.keyframes[0]
    assert pixel_scale(view) == 1
    window = replace(view.observation.window, side=500)
    assert pixel_scale(replace(view, observation=replace(view.observation, window=window))) == 2.5


def test_points_in_place_agree(object_map):
    view = object_map.keyframes[1]
    kept = find_inliers(object_map, CAMERA, view.pose, view.points, view)
    # Those near the outline do not, wherever they are.
    assert 10 < len(kept) <= len(view.points)


def test_points_near_the_outline_slide_and_are_dropped():
    object_map = map_with_points(ANGLES, beyond=0.05)
    view = object_map.keyframes[1]
    kept = find_inliers(object_map, CAMERA, view.pose, view.points, view)
    inside = view.mask | object_map.silhouette(view.pose, CAMERA)
    rows, columns = np.nonzero(~inside)
    gap = np.hypot(view.points.pixel[:, :1] - columns, view.points.pixel[:, 1:] - rows).min(1)
    assert (gap < 6).any()
    stay = np.isin(view.points.landmark, kept.landmark)
    assert not stay[gap < 7].any()
    assert stay[gap > 10].all()


def test_strays_are_dropped_and_landmarks_seen_once_get_more_room(object_map):
    view = object_map.keyframes[1]
    inside = find_inliers(object_map, CAMERA, view.pose, view.points, view)
    off = FollowedPoints(inside.landmark, inside.pixel + np.float32([6, 0]))
    assert len(find_inliers(object_map, CAMERA, view.pose, off, view)) == 0
    young = replace(object_map, keyframes=object_map.keyframes[1:2])
    assert len(find_inliers(young, CAMERA, view.pose, off, view)) > 0
    far = FollowedPoints(inside.landmark, inside.pixel + np.float32([17, 0]))
    assert len(find_inliers(young, CAMERA, view.pose, far, view)) == 0


def test_candidates_are_asked_neither_where_they_are_nor_what_they_lie_on(object_map):
    landmarks, candidate = object_map.landmarks.copy(), object_map.candidate.copy()
    landmarks[0], candidate[0] = np.nan, True
    view = object_map.keyframes[1]
    border = FollowedPoints(np.zeros(1, np.int64), np.float32([[1, 1]]))
    asking = replace(object_map, landmarks=landmarks, candidate=candidate)
    assert len(find_inliers(asking, CAMERA, view.pose, border, view)) == 1
    assert len(find_inliers(object_map, CAMERA, view.pose, border, view)) == 0


def test_no_points_agree_with_anything(object_map):
    view = object_map.keyframes[0]
    assert len(find_inliers(object_map, CAMERA, view.pose, FollowedPoints.none(), view)) == 0


def test_the_pose_of_points_is_theirs_whatever_a_few_say(object_map):
    view = replace(object_map.keyframes[1], pose=turned(8))
    pixel = pixels_of(object_map.landmarks, view)
    pixel[::5] += np.float32([20, -9])
    points = FollowedPoints(np.arange(len(pixel)), pixel)
    pose, kept = pose_of_points(object_map, CAMERA, points, pixel_scale(view))
    assert degrees_apart(pose, turned(8)) < 0.5
    np.testing.assert_allclose(pose.translation, turned(8).translation, atol=0.02)
    assert not np.isin(kept.landmark, np.arange(len(pixel))[::5]).any()
    assert len(kept) > 0.7 * len(pixel)


def test_near_a_prediction_the_points_pull_to_their_pose(object_map):
    true = object_map.keyframes[1].pose
    pixel = pixels_of(object_map.landmarks, replace(object_map.keyframes[1], pose=true))
    pixel[::5] += np.float32([20, -9])
    points = FollowedPoints(np.arange(len(pixel)), pixel)
    view = replace(object_map.keyframes[1], pose=at(4, 0.03), points=points)
    mature = points.only(object_map.sightings >= 2)
    assert len(mature) >= ENOUGH_MATURE
    pose = pose_near(object_map, CAMERA, view)
    assert degrees_apart(pose, true) < 0.3
    np.testing.assert_allclose(pose.translation, true.translation, atol=0.01)
    few = replace(view, points=FollowedPoints(mature.landmark[:20], mature.pixel[:20]))
    assert pose_near(object_map, CAMERA, few) is None
    # Landmarks of which it is not known whether they are on the object do not count.
    unsure = replace(object_map, candidate=np.ones_like(object_map.candidate))
    assert pose_near(unsure, CAMERA, view) is None


def test_few_points_have_no_pose(object_map):
    view = object_map.keyframes[1]
    few = view.points.only(np.arange(len(view.points)) < 5)
    assert pose_of_points(object_map, CAMERA, few, pixel_scale(view)) is None
    assert pose_of_points(object_map, CAMERA, FollowedPoints.none(), pixel_scale(view)) is None
    nowhere = replace(object_map, landmarks=np.full_like(object_map.landmarks, np.nan))
    assert pose_of_points(nowhere, CAMERA, view.points, pixel_scale(view)) is None
    # Five agree, and three others with nobody.
    pixel = view.points.pixel[:8].copy()
    pixel[5:] += np.float32([[25, 0], [0, 25], [-25, -12]])
    assert pose_of_points(object_map, CAMERA, FollowedPoints(np.arange(8), pixel), pixel_scale(view)) is None
    six = view.points.only(np.arange(len(view.points)) % 10 == 0)
    assert len(six) >= 6
    assert pose_of_points(object_map, CAMERA, six, pixel_scale(view)) is not None


def test_the_better_start_wins_and_is_refined(object_map, surface):
    view = turned_map([5.0]).keyframes[0]
    starts = {"far": turned(40), "near": turned(8), "other": turned(-30)}
    name, fit = fit_pose(object_map, surface, view, starts, FollowedPoints.none(), PoseWeights())
    assert name == "near"
    assert degrees_apart(fit.pose, turned(5)) < 1.5
    assert fit.overlap > 0.95


def test_a_mask_that_is_not_believed_does_not_pull(object_map, surface):
    view = turned_map([5.0]).keyframes[0]
    cut = view.mask.copy()
    cut[:, 32:] = False
    half = replace(view.observation, mask=torch.from_numpy(cut).float())
    starts = {"near": turned(5)}
    fits = [
        fit_pose(
            object_map, surface, replace(view, observation=half, mask=cut, mask_weight=weight), starts,
            FollowedPoints.none(), PoseWeights(appearance=0.2),
        )[1]
        for weight in (1.0, 0.02)
    ]  # fmt: skip
    moved = [float((fit.pose.translation - turned(5).translation).norm()) for fit in fits]
    assert moved[1] < 0.5 * moved[0]


def test_a_grid_of_rotations_finds_what_a_small_step_does_not(surface):
    view = turned_map([-20.0]).keyframes[0]
    best = search_rotations(surface, view, turned(20), PoseWeights())
    assert len(best) == 2
    assert min(degrees_apart(pose, turned(-20)) for pose in best) < 8


def test_keyframes_are_placed_where_the_mask_is(object_map):
    view = object_map.keyframes[0]
    moved = np.roll(view.mask, 10, axis=1)
    placed = aligned_keyframes(object_map, CAMERA, replace(view, mask=moved))
    assert len(placed) == 3
    for pose, keyframe in zip(placed, object_map.keyframes, strict=True):
        assert degrees_apart(pose, keyframe.pose) < 0.1
        x, y, z = pose.translation.tolist()
        centre = np.argwhere(moved)[:, ::-1].mean(0)
        np.testing.assert_allclose(
            [CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy], centre, atol=1e-3
        )
    assert aligned_keyframes(object_map, CAMERA, replace(view, mask=None)) == []


def test_witnesses_are_landmarks_that_two_keyframes_have_seen(object_map):
    first = object_map.keyframes[0]
    first = replace(first, points=first.points.only(first.points.landmark < 4))
    few = replace(object_map, keyframes=(first, object_map.keyframes[1]))
    assert count_inliers(few, object_map.keyframes[1].points) == 4
    assert count_inliers(few, FollowedPoints.none()) == 0


def test_evidence_is_the_cost_without_points(object_map, surface):
    view = turned_map([5.0]).keyframes[0]
    _, fit = fit_pose(object_map, surface, view, {"": turned(5)}, FollowedPoints.none(), PoseWeights())
    weights = PoseWeights(appearance=2.0, outline=0.5)
    expected = 2 * fit.appearance + 0.5 * 0.4 * fit.outline + 0.4 * (1 - fit.overlap)
    assert render_cost(fit, weights, 0.4) == pytest.approx(expected)
    assert render_cost(replace(fit, points=9.0), weights, 0.4) == pytest.approx(expected)
