"""Paths: rigid, smooth, as fast as asked, and doing what their names say."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tracking3d.geometry.alignment import is_rigid
from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis.motions import make_path
from tracking3d_bench.synthesis.pick_up import PICK_UP
from tracking3d_bench.synthesis.spec import Motion, SequenceSpec

MOTIONS = [motion for motion in get_args(Motion) if motion != PICK_UP]  # test_phone_suites.py has that one
CAMERA = Camera.from_fov(320, 240, 45.0)


def poses(motion, times=None, radius=1.0, camera=CAMERA, **settings):
    spec = SequenceSpec(motion=motion, **{"degrees_per_frame": 5.0, "seed": 3, **settings})
    return make_path(spec, camera, radius).T_cam_obj(np.arange(spec.frames) if times is None else times)


def turns(T):
    """Degrees between consecutive poses."""
    R = Rotation.from_matrix(T[:, :3, :3])
    return np.degrees((R[1:] * R[:-1].inv()).magnitude())


@pytest.mark.parametrize("motion", MOTIONS)
def test_paths_are_rigid_and_smooth_even_between_frames(motion):
    T = poses(motion, np.arange(0, 39, 0.1))
    assert all(is_rigid(pose, 1e-9) for pose in T)
    steps = turns(T)
    assert np.abs(np.diff(steps)).max() < 0.1 * max(steps.max(), 0.5)
    moves = np.diff(T[:, :3, 3], axis=0)
    assert np.abs(np.diff(moves, axis=0)).max() < 0.01


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("fov", [10.0, 45.0, 90.0])
def test_in_frame_0_the_object_is_centred_and_fills_the_asked_share_of_the_height(motion, seed, fov):
    camera = Camera.from_fov(320, 240, fov)
    centre = poses(motion, seed=seed, fill=0.6, radius=0.13, camera=camera)[0, :3, 3]
    assert centre[:2] == pytest.approx([0, 0])
    outline = camera.fy * 0.13 / np.sqrt(centre[2] ** 2 - 0.13**2)
    assert 2 * outline == pytest.approx(0.6 * 240)


@pytest.mark.parametrize("motion", ["tumble", "turntable", "depth_drift", "leave_and_return"])
@pytest.mark.parametrize("degrees", [0.0, 2.0, 8.0])
def test_steady_motions_turn_by_the_asked_angle_in_every_frame(motion, degrees):
    # An axis that wanders makes the turn from frame to frame a little shorter than the way there.
    assert turns(poses(motion, degrees_per_frame=degrees)) == pytest.approx(degrees, rel=0.01, abs=1e-6)


def test_a_fast_object_reaches_the_asked_speed_in_bursts_and_never_exceeds_it():
    steps = turns(poses("fast", degrees_per_frame=40.0))
    assert 36 < steps.max() <= 40
    assert steps.min() < 10


def test_the_turntable_turns_about_the_objects_own_upright_axis():
    T = poses("turntable")
    up = T[:, :3, 1]
    assert up == pytest.approx(np.tile(up[0], (len(up), 1)), abs=1e-9)
    assert up[0, 1] < -0.8  # upwards in the image


def test_a_full_turn_and_back_passes_the_far_side_and_comes_back_to_the_start():
    T = poses("turn_and_back", degrees_per_frame=8.0, frames=91)
    R = T[:, :3, :3]
    away = np.degrees(np.arccos(np.clip((np.einsum("nij,ij->n", R, R[0]) - 1) / 2, -1, 1)))
    assert away.max() > 175
    assert away[45] < 10 and away[-1] < 1
    assert 690 < turns(T).sum() <= 720
    assert turns(T).max() < 8.1


def test_a_card_is_flipped_to_its_other_side_and_is_slower_flat_than_on_edge():
    T = poses("flip", degrees_per_frame=6.0)
    facing = T[:, 2, 2]  # of the front's normal along the line of sight
    assert facing[0] < -0.8 and facing.max() > 0.8
    steps = turns(T)
    edge = np.abs(facing[:-1]) < 0.4
    assert steps[edge].mean() > 1.5 * steps[np.abs(facing[:-1]) > 0.9].mean()
    assert steps.mean() == pytest.approx(6.0, rel=0.2)


def test_a_drift_in_depth_doubles_the_distance():
    z = poses("depth_drift")[:, 2, 3]
    assert 1.8 < z[-1] / z[0] < 2.4
    assert poses("tumble")[:, 2, 3].std() < 0.15 * z[0]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("fov", [20.0, 45.0, 80.0])
def test_an_object_that_leaves_is_wholly_out_of_the_image_for_a_while_and_comes_back(seed, fov):
    camera = Camera.from_fov(320, 240, fov)
    centres = poses("leave_and_return", seed=seed, camera=camera)[:, :3, 3]
    # The distance from the frustum's side planes, in radii.
    slope = 160 / camera.fx
    outside = (np.abs(centres[:, 0]) - slope * centres[:, 2]) / np.hypot(1, slope)
    assert 4 <= (outside > 1).sum() <= 16
    assert outside[0] < -1 and outside[-1] < -0.8


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_seed_changes_the_path_and_the_number_of_frames_does_not_change_its_beginning(motion):
    assert np.abs(poses(motion, seed=3) - poses(motion, seed=4)).max() > 0.1
    if motion in ("tumble", "turntable", "flip", "fast"):
        assert poses(motion, frames=10) == pytest.approx(poses(motion, frames=30)[:10], abs=1e-9)


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_first_view_does_not_depend_on_the_speed(motion):
    slow, fast = (poses(motion, degrees_per_frame=degrees)[0] for degrees in (0.0, 20.0))
    assert slow == pytest.approx(fast, abs=1e-9)


def test_one_frame_alone_has_a_pose():
    for motion in MOTIONS:
        assert poses(motion, frames=1).shape == (1, 4, 4)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("fov", [8.0, 75.0])
def test_a_walking_camera_stays_above_and_upright_and_keeps_the_object_in_the_image(seed, fov):
    camera = Camera.from_fov(320, 240, fov)
    T = poses("walk_round", seed=seed, camera=camera, degrees_per_frame=3.0, fill=0.7)
    cameras = -np.einsum("nij,ni->nj", T[:, :3, :3], T[:, :3, 3])
    above = np.degrees(np.arcsin(cameras[:, 1] / np.linalg.norm(cameras, axis=1)))
    assert above.min() > 5 and above.max() < 45 and np.ptp(above) > 0.5
    round_it = np.degrees(np.unwrap(np.arctan2(cameras[:, 0], cameras[:, 2])))
    assert abs(round_it[-1] - round_it[0]) == pytest.approx(3.0 * 39, rel=0.1)
    up = T[:, :3, 1]  # of the object, in camera axes: y is down
    assert (up[:, 1] < -0.7).all() and (np.abs(up[:, 0]) < 0.1).all()

    centre, depth = T[:, :3, 3] @ camera.K.T, T[:, 2, 3]
    pixel = centre[:, :2] / centre[:, 2:]
    outline = camera.fy / np.sqrt(depth**2 - 1)
    assert (outline + np.abs(pixel[:, 1] - 119.5) < 125).all()  # but for a few pixels of the sphere around it
    away = np.linalg.norm(pixel - (159.5, 119.5), axis=1)
    assert away[0] < 1 and away.max() > 5
    assert 0.02 < np.ptp(depth) / depth[0] < 0.2


def test_a_camera_walks_either_way_round():
    ways = {
        np.sign(Rotation.from_matrix(T[1, :3, :3] @ T[0, :3, :3].T).as_rotvec()[1])
        for T in (poses("walk_round", seed=seed) for seed in range(8))
    }
    assert ways == {-1, 1}
