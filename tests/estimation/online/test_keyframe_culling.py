"""The map keeps a bounded number of keyframes, and only the landmarks that something refers to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from turned_solid import degrees_apart, turned, turned_map

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints
from tracking3d.estimation.online.mapping.keyframe_insertion import cull_keyframes, prune_landmarks

VIEW = turned_map([0.0]).keyframes[0]


def views_at(angles):
    return tuple(replace(VIEW, pose=turned(float(angle))) for angle in angles)


def angles_of(views):
    return [round(degrees_apart(view.pose, turned(0.0))) for view in views]


def test_few_enough_are_all_kept():
    views = views_at([0, 1, 2, 3])
    assert cull_keyframes(views, 4) == views


def test_of_the_two_most_alike_the_later_goes():
    assert angles_of(cull_keyframes(views_at([0, 10, 30, 33, 50, 70, 90, 110, 130]), 8)) == [
        0,
        10,
        30,
        50,
        70,
        90,
        110,
        130,
    ]


def test_the_later_one_goes_also_where_the_object_came_back():
    assert angles_of(cull_keyframes(views_at([0, 20, 40, 21, 60, 80, 100, 120]), 7)) == [
        0,
        20,
        40,
        60,
        80,
        100,
        120,
    ]


def test_the_first_stays_however_much_another_is_like_it():
    assert angles_of(cull_keyframes(views_at([0, 1, 30, 60, 90, 120, 150]), 6)) == [0, 30, 60, 90, 120, 150]


def test_the_recent_half_stays_however_alike():
    angles = [0, 20, 40, 60, 80, 101, 102, 103, 104]
    kept = angles_of(cull_keyframes(views_at(angles), 8))
    assert kept[-4:] == [101, 102, 103, 104]
    assert kept[0] == 0
    assert len(kept) == 8


def test_a_long_turn_stays_evenly_covered():
    views: tuple = ()
    for angle in range(0, 180, 2):
        views = cull_keyframes((*views, *views_at([angle])), 12)
    angles = angles_of(views)
    assert len(angles) == 12
    assert angles == sorted(angles)
    assert angles[0] == 0
    assert angles[-6:] == [168, 170, 172, 174, 176, 178]
    assert np.diff(angles[:7]).max() <= 45


def random_map(seed: int):
    """Landmarks, some of which nothing refers to, and views that show others."""
    random = np.random.default_rng(seed)
    count = 60

    def points(most):
        names = random.choice(count, most, replace=False).astype(np.int64)
        return FollowedPoints(names, random.uniform(0, 64, (most, 2)).astype(np.float32))

    views = tuple(
        replace(
            VIEW,
            points=points(12),
            keypoints=Keypoints(
                random.uniform(0, 64, (9, 2)).astype(np.float32), np.ones((9, 128), np.float32)
            ),
            keypoint_landmark=random.integers(-1, count, 9),
        )
        for _ in range(3)
    )
    object_map = replace(
        turned_map([0.0]),
        landmarks=random.normal(size=(count, 3)),
        candidate=random.random(count) < 0.3,
        keyframes=views,
    )
    return object_map, points(7)


def test_every_observation_still_refers_to_the_same_point():
    for seed in range(5):
        object_map, followed = random_map(seed)
        smaller, still = prune_landmarks(object_map, followed)
        used = set(followed.landmark)
        for view in object_map.keyframes:
            used |= set(view.points.landmark) | set(view.keypoint_landmark[view.keypoint_landmark >= 0])
        assert len(smaller.landmarks) == len(smaller.candidate) == len(used) < len(object_map.landmarks)
        pairs = [(followed, still)]
        for view, after in zip(object_map.keyframes, smaller.keyframes, strict=True):
            pairs.append((view.points, after.points))
            for old, new in zip(view.keypoint_landmark, after.keypoint_landmark, strict=True):
                if old < 0:
                    assert new == -1
                else:
                    np.testing.assert_array_equal(smaller.landmarks[new], object_map.landmarks[old])
        for before, after in pairs:
            np.testing.assert_array_equal(after.pixel, before.pixel)
            np.testing.assert_array_equal(
                smaller.landmarks[after.landmark], object_map.landmarks[before.landmark]
            )
            np.testing.assert_array_equal(
                smaller.candidate[after.landmark], object_map.candidate[before.landmark]
            )


def test_nothing_to_drop_changes_nothing():
    once, followed = prune_landmarks(*random_map(0))
    twice, still = prune_landmarks(once, followed)
    np.testing.assert_array_equal(twice.landmarks, once.landmarks)
    np.testing.assert_array_equal(still.landmark, followed.landmark)


def test_a_map_without_landmarks_stays_one():
    object_map = turned_map([0.0])
    smaller, followed = prune_landmarks(object_map, FollowedPoints.none())
    assert len(smaller.landmarks) == len(followed) == 0
