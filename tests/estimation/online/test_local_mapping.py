"""Landmarks of the map: where they lie, what they are called, and how far masks and outlines are believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from patterns import disc
from solid_points import map_with_points, pixels_of
from turned_solid import CAMERA, SIZE, degrees_apart, turned, turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.mapping.local_mapping import (
    is_well_inside,
    lift_pixels,
    mask_weight,
    nearest_views,
    refine_map,
    shared_landmarks,
    surface_places,
    to_window,
    tracks_of,
    viewing_angle,
    window_of,
    with_landmarks,
)
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.geometry.camera import Window
from tracking3d.geometry.pose import pose_arrays

ANGLES = [-10.0, 0.0, 10.0]
NO_CORNERS = np.zeros((0, 2), np.float32)


@pytest.fixture(scope="module")
def object_map():
    return map_with_points(ANGLES)


def described(pixel, kinds) -> Keypoints:
    """Keypoints that match where they are of one kind, and nowhere else."""
    rows = np.zeros((len(pixel), 128), np.float32)
    rows[np.arange(len(pixel)), kinds] = 1
    return Keypoints(np.asarray(pixel, np.float32).reshape(-1, 2), rows)


def test_pixels_of_the_surface_are_lifted_onto_it(object_map):
    for view in object_map.keyframes:
        points, met = lift_pixels(object_map, CAMERA, view, view.points.pixel)
        assert met.all()
        # The depth is that of a pixel half a pixel away at most: along the ray, not across.
        np.testing.assert_allclose(pixels_of(points, view), view.points.pixel, atol=1e-3)
        off = np.linalg.norm(points - object_map.landmarks, axis=1)
        assert np.median(off) < 0.015
        assert off.max() < 0.06


def test_pixels_beside_the_object_meet_nothing(object_map):
    view = object_map.keyframes[0]
    pixel = np.float32([[1, 1], [32, 32], [-30, 32], [62, 200]])
    assert lift_pixels(object_map, CAMERA, view, pixel)[1].tolist() == [False, True, False, False]


def test_what_the_window_does_not_show_is_not_lifted(object_map):
    view = object_map.keyframes[1]
    window = Window(24, 24, 16, 64)
    K = torch.tensor(window.K(CAMERA)).float()
    near = replace(view, observation=replace(view.observation, window=window, K=K))
    points, met = lift_pixels(object_map, CAMERA, near, np.float32([[32, 32], [23, 32], [32, 41]]))
    assert met.tolist() == [True, False, False]
    # The closer look meets the same place.
    whole, _ = lift_pixels(object_map, CAMERA, view, np.float32([[32, 32]]))
    np.testing.assert_allclose(points[0], whole[0], atol=0.02)


def test_windows_are_pixels_of_the_frame_scaled(object_map):
    view = object_map.keyframes[0]
    window = Window(10, 20, 32, 64)
    inside = replace(view, observation=replace(view.observation, window=window))
    np.testing.assert_allclose(
        to_window(inside, np.float32([[10, 20], [41, 51]])), [[0.5, 0.5], [62.5, 62.5]]
    )


@pytest.mark.parametrize(
    ("count", "most", "expected"),
    [
        (0, 6, []),
        (5, 6, [0, 1, 2, 3, 4]),
        (6, 6, [0, 1, 2, 3, 4, 5]),
        (7, 6, [0, 2, 3, 4, 5, 6]),
        (20, 6, [0, 8, 16, 17, 18, 19]),
        (20, 2, [0, 19]),
    ],
)
def test_the_window_is_the_first_the_recent_and_a_spread_of_the_older(count, most, expected):
    assert window_of(count, most) == expected


MASK = disc((200, 240), (120, 100), 40)


def points_at(*pixels) -> FollowedPoints:
    return FollowedPoints(np.arange(len(pixels)), np.float32(pixels))


@pytest.mark.parametrize(("outside", "weight"), [(0, 1.0), (1, 1.0), (3, 0.5), (5, 0.02), (20, 0.02)])
def test_a_mask_is_believed_as_far_as_points_lie_in_it(outside, weight):
    inside = [(120, 100)] * (20 - outside)
    points = points_at(*inside, *[(20, 20)] * outside)
    assert mask_weight(MASK, points) == pytest.approx(weight)


def test_few_points_or_no_mask_say_nothing_about_it():
    assert mask_weight(MASK, points_at(*[(20, 20)] * 11)) == 1
    assert mask_weight(None, points_at(*[(20, 20)] * 20)) == 1
    assert mask_weight(MASK, FollowedPoints.none()) == 1


def test_points_just_beside_the_mask_and_beyond_the_frame_are_no_traceback():
    assert mask_weight(MASK, points_at(*[(161, 100)] * 20)) == 1
    assert mask_weight(MASK, points_at(*[(-9, 700)] * 20)) == pytest.approx(0.02)


def test_well_inside_is_inside_of_mask_or_silhouette_and_away_from_the_outline_of_both():
    silhouette = disc((200, 240), (150, 100), 40)
    pixel = np.float32([[120, 100], [86, 100], [155, 100], [170, 100], [187, 100], [20, 20], [-5, 999]])
    assert is_well_inside(MASK, silhouette, pixel, 8).tolist() == [
        True,
        False,
        True,
        True,
        False,
        False,
        False,
    ]
    alone = is_well_inside(None, silhouette, pixel, 8)
    assert alone.tolist() == [True, False, True, True, False, False, False]
    assert not is_well_inside(None, silhouette, np.float32([[112, 100]]), 8).any()
    assert is_well_inside(MASK, silhouette, np.float32([[112, 100]]), 8).all()


def test_views_are_near_by_the_side_of_the_object_they_show(object_map):
    assert viewing_angle(turned(0), turned(30)) == pytest.approx(30, abs=0.1)
    views = turned_map([0.0, 50.0, 20.0, 35.0]).keyframes
    near = nearest_views(views, turned(30), 2)
    assert [round(degrees_apart(view.pose, turned(0))) for view in near] == [35, 20]
    assert nearest_views((), turned(0), 3) == []


def test_keypoints_are_landmarks_that_are_followed_or_found_again_or_new(object_map):
    followed_name, matched_name = 3, 7
    pixel = object_map.keyframes[1].points.pixel
    earlier = replace(
        object_map.keyframes[1],
        keypoints=described([pixel[matched_name], pixel[9]], [5, 6]),
        keypoint_landmark=np.array([matched_name, -1]),
    )
    before = replace(object_map, keyframes=(object_map.keyframes[0], earlier))
    followed = FollowedPoints(np.array([followed_name]), pixel[[followed_name]])
    view = replace(object_map.keyframes[1], points=followed)
    found = described(
        [pixel[followed_name] + 1, pixel[matched_name], pixel[9], [1, 1]],
        [1, 5, 6, 8],
    )
    after, named = with_landmarks(before, CAMERA, view, found, NO_CORNERS)
    new = len(object_map.landmarks)
    # Followed; found again; new, as what it matches has no name; beside the object.
    assert named.keypoint_landmark.tolist() == [followed_name, matched_name, new, -1]
    assert named.points.landmark.tolist() == [followed_name, matched_name, new]
    np.testing.assert_allclose(named.points.pixel, pixel[[followed_name, matched_name, 9]])
    assert len(after.landmarks) == len(after.candidate) == new + 1
    assert not after.candidate[new]
    np.testing.assert_allclose(after.landmarks[new], object_map.landmarks[9], atol=0.04)
    np.testing.assert_array_equal(after.landmarks[:new], object_map.landmarks)


def test_a_match_far_from_where_its_landmark_is_seen_is_a_new_point(object_map):
    pixel = object_map.keyframes[1].points.pixel
    order = np.argsort(pixel[:, 0])
    left, right = int(order[0]), int(order[-1])
    assert np.linalg.norm(pixel[left] - pixel[right]) > 13
    # A second one elsewhere is what a match is clearer than.
    earlier = replace(
        object_map.keyframes[1],
        keypoints=described([pixel[left], [60, 60]], [5, 70]),
        keypoint_landmark=np.array([left, -1]),
    )
    before = replace(object_map, keyframes=(earlier,))
    view = replace(object_map.keyframes[1], points=FollowedPoints.none())
    for place, name in ((pixel[left], left), (pixel[right], len(object_map.landmarks))):
        _, named = with_landmarks(before, CAMERA, view, described([place], [5]), NO_CORNERS)
        assert named.keypoint_landmark.tolist() == [name]


def test_no_name_is_given_twice(object_map):
    pixel = object_map.keyframes[1].points.pixel
    earlier = replace(
        object_map.keyframes[1],
        keypoints=described([pixel[7], [60, 60]], [5, 70]),
        keypoint_landmark=np.array([7, -1]),
    )
    before = replace(object_map, keyframes=(earlier,))
    view = replace(object_map.keyframes[1], points=FollowedPoints(np.array([7]), pixel[[7]] + 4))
    _, named = with_landmarks(before, CAMERA, view, described([pixel[7]], [5]), NO_CORNERS)
    assert np.unique(named.points.landmark).size == len(named.points) == 2
    assert named.keypoint_landmark[0] == len(object_map.landmarks)


def test_corners_become_landmarks_where_they_meet_the_surface(object_map):
    view = replace(object_map.keyframes[1], points=FollowedPoints.none())
    corners = np.concatenate([object_map.keyframes[1].points.pixel[:2], np.float32([[1, 1]])])
    after, named = with_landmarks(object_map, CAMERA, view, Keypoints.none(), corners)
    new = len(object_map.landmarks)
    assert named.points.landmark.tolist() == [new, new + 1]
    np.testing.assert_array_equal(named.points.pixel, corners[:2])
    assert len(after.landmarks) == new + 2


def test_shared_landmarks_are_those_that_two_views_show_and_no_candidates(object_map):
    first, second = object_map.keyframes[:2]
    views = [
        replace(first, points=first.points.only(first.points.landmark < 6)),
        replace(second, points=second.points.only(second.points.landmark % 2 == 0)),
    ]
    candidate = object_map.candidate.copy()
    candidate[2] = True
    assert shared_landmarks(replace(object_map, candidate=candidate), views).tolist() == [0, 4]


def test_tracks_are_what_the_views_show_of_the_named_landmarks(object_map):
    first, second = object_map.keyframes[:2]
    turned_round = FollowedPoints(second.points.landmark[::-1], second.points.pixel[::-1])
    views = [
        replace(first, points=first.points.only(first.points.landmark != 4)),
        replace(second, points=turned_round),
    ]
    names = np.array([1, 4, len(object_map.landmarks) - 1])
    tracks = tracks_of(views, names)
    assert tracks.visible.tolist() == [[True, False, True], [True, True, True]]
    np.testing.assert_array_equal(tracks.pixels[1], second.points.pixel[names])
    np.testing.assert_array_equal(tracks.pixels[0, [0, 2]], first.points.pixel[names[[0, 2]]])


def test_places_on_the_surface_come_from_the_first_view_that_shows_a_landmark(object_map):
    first, second = object_map.keyframes[:2]
    wrong = replace(second, points=FollowedPoints(second.points.landmark, second.points.pixel + 5))
    names = np.arange(3)
    views = [replace(first, points=first.points.only(first.points.landmark < 2)), wrong]
    places = surface_places(object_map, CAMERA, views, names)
    assert np.linalg.norm(places[:2] - object_map.landmarks[:2], axis=1).max() < 0.05
    assert np.linalg.norm(places[2] - object_map.landmarks[2]) > 0.1
    unseen = surface_places(object_map, CAMERA, views[:1], names)
    assert np.isnan(unseen[2]).all()


def test_refining_puts_disturbed_poses_right_and_keeps_the_first():
    angles = [-20.0, -10.0, 0.0, 10.0, 20.0]
    true = map_with_points(angles)
    wrong = [turned(angle + change) for angle, change in zip(angles, (0, 3, -3, 2, -2), strict=True)]
    views = tuple(replace(view, pose=pose) for view, pose in zip(true.keyframes, wrong, strict=True))
    object_map = replace(true, keyframes=views)
    better = refine_map(
        object_map, CAMERA, list(range(5)), weights=FitWeights(), prior=20.0, bundle_iterations=20
    )
    for before, after in zip(pose_arrays(wrong[0]), pose_arrays(better.keyframes[0].pose), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-6)
    errors = [
        degrees_apart(view.pose, turned(angle)) for view, angle in zip(better.keyframes, angles, strict=True)
    ]
    assert max(errors) < 1
    assert all(view.texture is not None for view in better.keyframes)
    # Positions that take no part stay as they are.
    some = refine_map(object_map, CAMERA, [0, 1], weights=FitWeights(), prior=20.0)
    assert some.keyframes[3] is object_map.keyframes[3]


def test_a_point_that_does_not_move_with_the_others_is_no_longer_shown():
    true = map_with_points([-20.0, -10.0, 0.0, 10.0, 20.0])
    views = list(true.keyframes)
    pixel = views[2].points.pixel.copy()
    pixel[0] += np.float32([0, 12])
    views[2] = replace(views[2], points=FollowedPoints(views[2].points.landmark, pixel))
    better = refine_map(
        replace(true, keyframes=tuple(views)),
        CAMERA,
        list(range(5)),
        weights=FitWeights(),
        prior=20.0,
        rounds=0,
    )
    assert 0 not in better.keyframes[2].points.landmark
    assert all(0 in better.keyframes[n].points.landmark for n in (0, 1, 3, 4))
    assert len(better.keyframes[2].points) == len(pixel) - 1


def test_the_solid_fills_its_frame():
    # What the tests above rely on.
    mask = turned_map([0.0]).keyframes[0].mask
    assert mask[32, 32]
    assert 0.1 < mask.sum() / SIZE**2 < 0.6
