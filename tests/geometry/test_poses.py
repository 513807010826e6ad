"""Poses: conversions, angles between them, and constant velocity."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck
from torch.nn import functional

from tracking3d.geometry.pose import (
    Pose,
    extrapolate,
    from_matrix,
    rotation_about,
    rotation_angle,
    rotation_exponential,
)


def quaternion(vector: list[float]) -> torch.Tensor:
    """``(4,)`` w first, from a rotation vector in degrees."""
    return torch.tensor(Rotation.from_rotvec(vector, degrees=True).as_quat(scalar_first=True))


def pose(vector: list[float], translation: list[float]) -> Pose:
    return Pose(torch.tensor(translation, dtype=torch.float64), quaternion(vector))


TURNS = [
    [0.0, 0.0, 0.0],
    [10.0, 0.0, 0.0],
    [0.0, 90.0, 0.0],
    [30.0, -100.0, 60.0],
    [0.0, 0.0, 179.0],
    [1e-6, 0, 0],
]


@pytest.mark.parametrize("turn", TURNS)
def test_a_quaternion_is_w_first_and_turns_as_its_matrix(turn):
    expected = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    np.testing.assert_allclose(pose(turn, [0.0, 0.0, 0.0]).R, expected, atol=1e-9)


@pytest.mark.parametrize("turn", TURNS)
def test_from_matrix_and_back_is_the_same_pose(turn):
    one = pose(turn, [1.0, 2.0, 3.0])
    again = from_matrix(one.R, one.translation)
    np.testing.assert_allclose(again.R, one.R, atol=1e-7)
    assert torch.equal(again.translation, one.translation)
    assert torch.linalg.norm(again.quaternion).item() == pytest.approx(1.0)


def test_the_matrix_maps_object_to_camera_coordinates():
    one = pose([0.0, 0.0, 90.0], [1.0, 2.0, 3.0])
    x_cam = one.matrix() @ torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    assert x_cam.tolist() == pytest.approx([1.0, 3.0, 3.0, 1.0])


def test_who_changes_a_matrix_does_not_change_the_pose():
    one = pose([0.0, 0.0, 90.0], [1.0, 2.0, 3.0])
    one.matrix()[:] = 0
    assert one.matrix()[:3, 3].tolist() == [1.0, 2.0, 3.0]


def test_the_matrix_is_float64_whatever_the_pose():
    one = Pose(torch.ones(3, requires_grad=True), torch.tensor([1.0, 0, 0, 0], requires_grad=True))
    assert one.matrix().dtype == torch.float64 and not one.matrix().requires_grad


def test_batches_are_stacked_indexed_and_of_one_shape():
    poses = [pose([10.0 * k, 0.0, 0.0], [float(k), 0.0, 1.0]) for k in range(4)]
    batch = Pose.stack(poses)
    assert batch.R.shape == (4, 3, 3)
    torch.testing.assert_close(batch[2].R, poses[2].R)
    assert Pose.identity(torch.zeros(3)).R.equal(torch.eye(3))
    assert Pose.identity(torch.zeros(5, 3)).quaternion.shape == (5, 4)
    assert Pose.identity(torch.zeros(5, 3)).R.shape == (5, 3, 3)


def test_detached_poses_are_copies_of_unit_length():
    leaf = torch.tensor([2.0, 0.0, 2.0, 0.0], requires_grad=True)
    detached = Pose(torch.zeros(3, requires_grad=True), leaf).detach()
    assert not detached.quaternion.requires_grad and not detached.translation.requires_grad
    assert detached.quaternion.tolist() == pytest.approx([math.sqrt(0.5), 0, math.sqrt(0.5), 0])
    detached.translation[0] = 9.0
    assert leaf[0] == 2.0


@pytest.mark.parametrize("degrees", [0.0, 1e-5, 0.01, 1.0, 45.0, 90.0, 179.0, 180.0])
def test_the_angle_between_rotations_is_that_of_their_difference(degrees):
    axis = np.array([0.3, -0.8, 0.5]) / np.linalg.norm([0.3, -0.8, 0.5])
    first = Rotation.from_rotvec([20, 40, -30], degrees=True)
    second = Rotation.from_rotvec(degrees * axis, degrees=True) * first
    a, b = (torch.tensor(r.as_quat(scalar_first=True)) for r in (first, second))
    for sign in (1, -1):  # q and -q are one rotation
        assert math.degrees(rotation_angle(a, sign * b)) == pytest.approx(degrees, abs=1e-6)
        assert math.degrees(rotation_angle(3 * b, a)) == pytest.approx(degrees, abs=1e-6)


def test_the_angles_of_a_batch_are_those_of_its_members():
    a = torch.stack([quaternion(turn) for turn in TURNS])
    b = a.flip(0)
    one_by_one = torch.stack([rotation_angle(x, y) for x, y in zip(a, b, strict=True)])
    torch.testing.assert_close(rotation_angle(a, b), one_by_one)


def test_the_angles_gradient_is_that_of_finite_differences():
    a, b = quaternion([20.0, 10.0, 0.0]).requires_grad_(), quaternion([-30.0, 50.0, 5.0]).requires_grad_()
    assert gradcheck(rotation_angle, (a, b))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_angles_gradient_is_finite_at_no_rotation_at_all(sign, dtype):
    a = quaternion([20.0, 10.0, 0.0]).to(dtype)
    b = (sign * a).clone().requires_grad_()
    rotation_angle(a, b).backward()
    assert b.grad.isfinite().all()


@pytest.mark.parametrize("steps", [0.0, 0.5, 1.0, 2.0])
def test_constant_velocity_goes_on_as_before(steps):
    axis = np.array([0.2, 1.0, -0.3]) / np.linalg.norm([0.2, 1.0, -0.3])
    poses = [pose((angle * axis).tolist(), [0.1 * angle, 0.0, 4.0 - 0.05 * angle]) for angle in (10, 18)]
    expected = pose(((18 + 8 * steps) * axis).tolist(), [1.8 + 0.8 * steps, 0.0, 3.1 - 0.4 * steps])
    found = extrapolate(poses[0], poses[1], steps)
    torch.testing.assert_close(found.R, expected.R, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.translation, expected.translation)


def test_an_object_at_rest_stays_at_rest():
    one = pose([30.0, 20.0, 10.0], [1.0, 2.0, 3.0])
    found = extrapolate(one, one)
    torch.testing.assert_close(found.R, one.R, atol=1e-6, rtol=0)
    torch.testing.assert_close(found.translation, one.translation)


def test_extrapolation_over_and_over_keeps_rotations_rotations():
    before, last = (
        Pose(p.translation.float(), p.quaternion.float())
        for p in (pose([0, 0, 0], [0, 0, 4]), pose([3, 9, 1], [0, 0, 4]))
    )
    for _ in range(200):
        before, last = last, extrapolate(before, last).detach()
    torch.testing.assert_close(last.R @ last.R.T, torch.eye(3), atol=1e-5, rtol=0)


def test_a_rotation_about_an_axis_is_by_the_right_hand():
    turned = rotation_about(torch.tensor([0.0, 0.0, 2.0]), 90.0) @ torch.tensor([1.0, 0.0, 0.0])
    torch.testing.assert_close(turned, torch.tensor([0.0, 1.0, 0.0]), atol=1e-6, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_single_rotation_is_converted_to_the_same_digits_as_by_kornia(dtype):
    drawn = torch.randn(200, 4, dtype=dtype, generator=torch.Generator().manual_seed(5))
    drawn[:40] = functional.normalize(drawn[:40], dim=1)
    drawn[40:60, 0] *= 1e-3  # half turns
    drawn[60] = 0
    drawn[61] = 1e-13
    drawn[62] = math.nan
    matrices = quaternion_to_rotation_matrix(drawn)
    for one, R, again in zip(drawn, matrices, rotation_matrix_to_quaternion(matrices), strict=True):
        assert torch.equal(Pose(torch.zeros(3), one).R.nan_to_num(9), R.nan_to_num(9))
        assert torch.equal(from_matrix(R, torch.zeros(3)).quaternion.nan_to_num(9), again.nan_to_num(9))


def test_many_rotations_about_axes_have_the_digits_of_each_by_itself():
    turns = torch.randn(3, 7, 3, generator=torch.Generator().manual_seed(6))
    turns[0, 0] = 0
    together = rotation_exponential(turns)
    assert torch.equal(
        together, torch.stack([torch.stack(list(map(rotation_exponential, row))) for row in turns])
    )
    judge = Rotation.from_rotvec(turns.reshape(-1, 3).double().numpy()).as_matrix()
    np.testing.assert_allclose(together.reshape(-1, 3, 3), judge, atol=1e-6)


def test_a_rotation_that_is_solved_for_has_gradients():
    quaternion = torch.tensor([1.0, 0.1, 0.0, 0.0], requires_grad=True)
    Pose(torch.zeros(3), quaternion).R.sum().backward()
    assert quaternion.grad is not None and quaternion.grad.abs().sum() > 0
