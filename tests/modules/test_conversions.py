"""Our cameras and poses as kornia's and back: the same numbers, the same pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from kornia.geometry.quaternion import Quaternion
from scipy.spatial.transform import Rotation

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.modules import (
    camera_from_pinhole,
    pinhole_of_camera,
    pose_from_se3,
    quaternion_from_kornia,
    quaternion_of_pose,
    se3_from_matrix,
    se3_of_pose,
)
from tracking3d.rendering import project

CAMERA = Camera(210.5, 190.25, 101.5, 77.25, 204, 152)
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])


@pytest.fixture
def pose() -> Pose:
    quaternion = torch.tensor(TURN.as_quat(scalar_first=True))
    return Pose(torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64), quaternion)


def test_a_camera_comes_back_as_it_was():
    pinhole = pinhole_of_camera(CAMERA, views=3, dtype=torch.float64)
    assert pinhole.batch_size == 3
    for view in range(3):
        back = camera_from_pinhole(pinhole, view)
        assert (back.K == CAMERA.K).all() and (back.width, back.height) == (204, 152)


def test_kornia_projects_to_the_same_pixels(pose):
    points = torch.tensor(np.random.default_rng(0).normal(size=(1, 20, 3)))
    pinhole = pinhole_of_camera(CAMERA, dtype=torch.float64)
    ours, _ = project(points[0], pose.R[None], pose.translation[None], torch.tensor(CAMERA.K)[None])
    motion = se3_of_pose(pose)
    moved = torch.stack([motion * point for point in points[0]])[None]
    torch.testing.assert_close(pinhole.project(moved), ours)
    posed = PinholeCamera(pinhole.intrinsics, motion.matrix()[None].detach(), pinhole.height, pinhole.width)
    torch.testing.assert_close(posed.project(points), ours)


def test_a_pose_comes_back_as_it_was(pose):
    back = pose_from_se3(se3_of_pose(pose))
    torch.testing.assert_close(back.quaternion, pose.quaternion)
    torch.testing.assert_close(back.translation.detach(), pose.translation)
    torch.testing.assert_close(se3_of_pose(pose).matrix().detach(), pose.matrix())


def test_many_poses_come_back_as_they_were(pose):
    both = Pose.stack([pose, Pose.identity(torch.tensor([1.0, 2, 3], dtype=torch.float64))])
    motion = se3_of_pose(both)
    assert motion.matrix().shape == (2, 4, 4)
    torch.testing.assert_close(pose_from_se3(motion).quaternion, both.quaternion)


def test_matrices_of_a_result_become_kornia_s(pose):
    T = np.stack([pose.matrix().numpy(), np.eye(4)])
    torch.testing.assert_close(se3_from_matrix(T, torch.float64).matrix().detach(), torch.tensor(T))
    assert se3_from_matrix(T[0]).matrix().shape == (4, 4)
    with pytest.raises(InputError, match=r"^T_cam_obj= has shape \(3, 3\); give \(4, 4\)"):
        se3_from_matrix(np.eye(3))


def test_w_comes_first_in_both(pose):
    """SciPy, whose order is x, y, z, w, is the judge."""
    theirs = quaternion_of_pose(pose)
    assert float(theirs.w) == pytest.approx(TURN.as_quat()[3])
    np.testing.assert_allclose(theirs.matrix().detach(), TURN.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(quaternion_from_kornia(theirs), TURN.as_quat(scalar_first=True))
    longer = Quaternion(3 * pose.quaternion[None])
    torch.testing.assert_close(quaternion_from_kornia(longer)[0], pose.quaternion)


def test_gradients_go_through(pose):
    quaternion = pose.quaternion[None].clone().requires_grad_()
    motion = Se3(Quaternion(quaternion), pose.translation[None])
    pose_from_se3(motion).R[0, 0, 1].backward()
    assert quaternion.grad.abs().sum() > 0


@pytest.mark.parametrize(
    ("K", "size", "sentence"),
    [
        ([[1.0, 0.5], [0, 1]], (4, 5), r"^pinhole= has a skew of 0.5"),
        ([[1.0, 0], [0, 1]], (4.5, 5), r"^pinhole= is 5 x 4.5"),
    ],
)
def test_what_is_no_camera_of_ours_is_refused(K, size, sentence):
    intrinsics = torch.eye(4)[None].clone()
    intrinsics[0, :2, :2] = torch.tensor(K)
    with pytest.raises(InputError, match=sentence):
        camera_from_pinhole(PinholeCamera(intrinsics, torch.eye(4)[None], *torch.tensor(size)[:, None]))
