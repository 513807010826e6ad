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

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.online import mapper
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapper import fix_depth_reversal
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.estimation.segmentation.online_motion_cue import MotionReference
from tracking3d.geometry.pose import pose_from_arrays
from tracking3d.points.bundle_adjustment.adjustment import reversal_of
from tracking3d.points.bundle_adjustment.reprojection import project_camera_points, transform_to_camera

ANGLES = [0.0, 10.0, 20.0, 30.0, 40.0]


def transforms(object_map) -> np.ndarray:
    return np.stack([view.pose.matrix().numpy() for view in object_map.keyframes])


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
    earlier = MotionReference(np.zeros((4, 4), np.uint8), np.zeros((4, 4), bool), np.eye(4), (4, 4))
    believing = replace(believed(wrong_way_round(true)), motion_references=(earlier,))
    state = fix_depth_reversal(believing, OnlineConfig())
    off = [
        degrees_apart(found.pose, view.pose)
        for found, view in zip(state.object_map.keyframes, true.keyframes, strict=True)
    ]
    assert max(off) < 4
    assert state.last_pose[0] is state.object_map.keyframes[-1].pose
    assert degrees_apart(state.trajectory[0][0], true.keyframes[-1].pose) < 8  # motion goes on the right way
    assert not state.motion_references  # frames with poses of the wrong way tell no motion


def test_a_map_that_is_right_stays():
    state = believed(map_with_points(ANGLES))
    tried = fix_depth_reversal(state, OnlineConfig())
    assert tried.object_map is state.object_map
    assert tried.reversal_attempt == (len(ANGLES), pytest.approx(40))


def test_many_keyframes_that_show_nothing_new_are_not_tried_again(monkeypatch):
    """Each try costs as much as bundling all of them; without this a long video spent a third of its time on it."""
    tried: list[int] = []
    monkeypatch.setattr(
        mapper,
        "_better_reversal",
        lambda object_map, camera: tried.append(len(object_map.keyframes)),
    )
    view = map_with_points([0.0, 40.0])
    first, last = view.keyframes
    state = believed(view)
    for count in range(4, 65):
        object_map = replace(view, keyframes=(first,) * (count - 1) + (last,))
        state = fix_depth_reversal(replace(state, object_map=object_map), OnlineConfig())
    assert tried[:9] == list(range(4, 13))  # all of them while there are few
    assert all(later >= 1.25 * earlier for earlier, later in pairwise(tried[8:]))
    assert tried[-1] > 45
    sides = map_with_points([0.0, 50.0]).keyframes
    state = fix_depth_reversal(
        replace(state, object_map=replace(object_map, keyframes=(*object_map.keyframes, sides[1]))),
        OnlineConfig(),
    )
    assert tried[-1] == 65  # a new side is something new


@pytest.mark.parametrize("angles", [[0.0, 10.0, 20.0], [0.0, 40.0, 80.0, 120.0]])
def test_too_few_or_too_many_sides_are_not_asked(angles):
    state = believed(wrong_way_round(map_with_points(angles, beyond=0.2)))
    assert fix_depth_reversal(state, OnlineConfig()) is state


def wrong_way_round(object_map: ObjectMap) -> ObjectMap:
    """The same images, explained with depth reversed."""
    reversal = reversal_of(object_map.landmarks, transforms(object_map)[0])
    moved = [
        pose_from_arrays(T[:3, :3], T[:3, 3], object_map.vertices)
        for T in reversal.poses(transforms(object_map))
    ]
    landmarks = reversal.points(object_map.landmarks)
    bent = reversal.surface(object_map.vertices.double().numpy(), object_map.landmarks, landmarks)
    return replace(
        object_map,
        vertices=torch.from_numpy(bent).to(object_map.vertices),
        landmarks=landmarks,
        keyframes=tuple(replace(v, pose=pose) for v, pose in zip(object_map.keyframes, moved, strict=True)),
    )


def believed(object_map: ObjectMap) -> Mapped:
    last = object_map.keyframes[-1].pose, object_map.keyframes[-1].index
    picture = np.zeros((SIZE, SIZE), np.uint8)
    points, surface = FollowedPoints.none(), object_map.surface()
    return Mapped(CAMERA, object_map, last, picture, points, surface=surface, trajectory=(last,))
