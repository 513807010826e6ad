"""Depth the other way round: the same images from afar, and the map that is put right by perspective."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from solid_points import map_with_points
from tracked_solids import scene
from turned_solid import CAMERA, SIZE, degrees_apart

from tracking3d.bundle_adjustment.reprojection import project_camera_points, transform_to_camera
from tracking3d.bundle_adjustment.reversal import reversal_of
from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online import reversal as online_reversal
from tracking3d.estimation.online.belief import Belief, ObjectMap
from tracking3d.estimation.online.mapping import pose_of
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.reversal import turned_round
from tracking3d.evidence.moving_along import Glimpse

ANGLES = [0.0, 10.0, 20.0, 30.0, 40.0]


def transforms(known) -> np.ndarray:
    return np.stack([view.pose.matrix().numpy() for view in known.keyframes])


def of_scene(**kind) -> tuple:
    """Points, poses, K of a solid that turns."""
    solid = scene(**kind)
    T = np.tile(np.eye(4), (len(solid.truth.R), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = solid.truth.R, solid.truth.t
    return solid.truth.points, T, solid.K


@pytest.mark.parametrize(("fov", "pixels"), [(1.0, 0.5), (0.1, 0.05)])
def test_from_afar_both_ways_round_look_the_same(fov, pixels):
    points, T, K = of_scene(fov=fov)
    reversal = reversal_of(points, T[2])
    other = reversal.poses(T)
    seen = project_camera_points(transform_to_camera(T[:, :3, :3], T[:, :3, 3], points), K)
    seen_reversed = project_camera_points(
        transform_to_camera(other[:, :3, :3], other[:, :3, 3], reversal.points(points)), K
    )
    assert np.abs(seen - seen_reversed).max() < pixels
    # Yet they turn the other way: the given view stays, the last one is far off.
    np.testing.assert_allclose(other[2], T[2], atol=1e-9)
    apart = Rotation.from_matrix(other[-1, :3, :3] @ T[-1, :3, :3].T).magnitude()
    assert np.degrees(apart) > 20


def test_twice_the_other_way_round_is_as_before():
    points, T, _ = of_scene()
    reversal = reversal_of(points, T[1])
    np.testing.assert_allclose(reversal.points(reversal.points(points)), points, atol=1e-12)
    np.testing.assert_allclose(reversal.poses(reversal.poses(T)), T, atol=1e-9)
    turns = reversal.poses(T)[:, :3, :3]
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (len(T), 1, 1)), atol=1e-9
    )
    np.testing.assert_allclose(np.linalg.det(turns), 1.0)


def test_a_plate_changes_its_slant_and_is_not_turned_inside_out():
    random = np.random.default_rng(0)
    x, y = random.uniform(-1, 1, (2, 300))
    front = np.column_stack([x, y, 0.6 * x])
    thick = np.array([0, 0, 0.3])
    plate = np.concatenate([front, front + thick])
    T = np.eye(4)
    T[2, 3] = 50.0
    reversal = reversal_of(front - front.mean(0), T)
    front, plate = front - front.mean(0), plate - front.mean(0)
    sheared = reversal.surface(plate, front, reversal.points(front))
    np.testing.assert_allclose(sheared[:300, 2], -front[:, 2], atol=1e-9)
    np.testing.assert_allclose(sheared[300:, 2] - sheared[:300, 2], 0.3, atol=1e-9)  # as thick as before
    np.testing.assert_allclose(sheared[:, :2], plate[:, :2], atol=1e-9)


def test_a_map_that_is_the_wrong_way_round_is_turned():
    true = map_with_points(ANGLES)
    earlier = Glimpse(np.zeros((4, 4), np.uint8), np.zeros((4, 4), bool), np.eye(4), (4, 4))
    believing = replace(believed(wrong_way_round(true)), past=(earlier,))
    belief = turned_round(believing, OnlineConfig())
    off = [
        degrees_apart(found.pose, view.pose)
        for found, view in zip(belief.known.keyframes, true.keyframes, strict=True)
    ]
    assert max(off) < 4
    assert belief.last[0] is belief.known.keyframes[-1].pose
    assert degrees_apart(belief.trail[0][0], true.keyframes[-1].pose) < 8  # motion goes on the right way
    assert not belief.past  # frames with poses of the wrong way tell no motion


def test_a_map_that_is_right_stays():
    belief = believed(map_with_points(ANGLES))
    tried = turned_round(belief, OnlineConfig())
    assert tried.known is belief.known
    assert tried.reversal_tried == (len(ANGLES), pytest.approx(40))


def test_many_keyframes_that_show_nothing_new_are_not_tried_again(monkeypatch):
    """Each try costs as much as bundling all of them; without this a long video spent a third of its time on it."""
    tried: list[int] = []
    monkeypatch.setattr(
        online_reversal, "_better_reversed", lambda known, camera: tried.append(len(known.keyframes))
    )
    view = map_with_points([0.0, 40.0])
    first, last = view.keyframes
    belief = believed(view)
    for count in range(4, 65):
        known = replace(view, keyframes=(first,) * (count - 1) + (last,))
        belief = turned_round(replace(belief, known=known), OnlineConfig())
    assert tried[:9] == list(range(4, 13))  # all of them while there are few
    assert all(later >= 1.25 * earlier for earlier, later in pairwise(tried[8:]))
    assert tried[-1] > 45
    sides = map_with_points([0.0, 50.0]).keyframes
    belief = turned_round(
        replace(belief, known=replace(known, keyframes=(*known.keyframes, sides[1]))), OnlineConfig()
    )
    assert tried[-1] == 65  # a new side is something new


@pytest.mark.parametrize("angles", [[0.0, 10.0, 20.0], [0.0, 40.0, 80.0, 120.0]])
def test_too_few_or_too_many_sides_are_not_asked(angles):
    belief = believed(wrong_way_round(map_with_points(angles, beyond=0.2)))
    assert turned_round(belief, OnlineConfig()) is belief


def wrong_way_round(known: ObjectMap) -> ObjectMap:
    """The same images, explained with depth reversed."""
    reversal = reversal_of(known.landmarks, transforms(known)[0])
    moved = [pose_of(T[:3, :3], T[:3, 3], known.vertices) for T in reversal.poses(transforms(known))]
    landmarks = reversal.points(known.landmarks)
    bent = reversal.surface(known.vertices.double().numpy(), known.landmarks, landmarks)
    return replace(
        known,
        vertices=torch.from_numpy(bent).to(known.vertices),
        landmarks=landmarks,
        keyframes=tuple(replace(v, pose=pose) for v, pose in zip(known.keyframes, moved, strict=True)),
    )


def believed(known: ObjectMap) -> Belief:
    last = known.keyframes[-1].pose, known.keyframes[-1].index
    picture = np.zeros((SIZE, SIZE), np.uint8)
    return Belief(CAMERA, known, None, last, None, picture, FollowedPoints.none(), trail=(last,))
