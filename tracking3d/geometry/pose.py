"""Poses as translation and unit quaternion (w, x, y, z); conversions are kornia's, or give the same digits.

``T_cam_obj`` maps object to camera coordinates: ``x_cam = R x_obj + t``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from tracking3d.geometry.single_rotation import is_single, matrix_of, quaternion_of


@dataclass(frozen=True, eq=False)
class Pose:
    """One pose, or a batch of them.

    Attributes:
        translation: ``(..., 3)``.
        quaternion: ``(..., 4)``, w first, unit length.
    """

    translation: Tensor
    quaternion: Tensor

    @classmethod
    def identity(cls, translation: Tensor) -> Pose:
        """No rotation, at one translation or a batch of them."""
        quaternion = translation.new_tensor([1.0, 0.0, 0.0, 0.0])
        return cls(translation, quaternion.expand(*translation.shape[:-1], 4))

    @classmethod
    def stack(cls, poses: list[Pose]) -> Pose:
        """One batch of many."""
        return cls(torch.stack([p.translation for p in poses]), torch.stack([p.quaternion for p in poses]))

    def __getitem__(self, index: int) -> Pose:
        """One pose of a batch."""
        return Pose(self.translation[index], self.quaternion[index])

    def detach(self) -> Pose:
        """A copy without gradients, its quaternion brought back to unit length."""
        quaternion = functional.normalize(self.quaternion.detach(), dim=-1)
        return Pose(self.translation.detach().clone(), quaternion)

    @property
    def R(self) -> Tensor:
        """``(..., 3, 3)`` rotation matrix."""
        if is_single(self.quaternion, 1):
            return matrix_of(self.quaternion)
        from kornia.geometry.conversions import quaternion_to_rotation_matrix

        result: Tensor = quaternion_to_rotation_matrix(self.quaternion)
        return result

    def matrix(self) -> Tensor:
        """``(4, 4)`` float64 ``T_cam_obj`` of a single pose, on the CPU."""
        pose = Pose(self.translation.detach().double().cpu(), self.quaternion.detach().double().cpu())
        T_cam_obj = torch.eye(4, dtype=torch.float64)
        T_cam_obj[:3, :3] = pose.R
        T_cam_obj[:3, 3] = pose.translation
        return T_cam_obj


def from_matrix(R: Tensor, translation: Tensor) -> Pose:
    """A pose, or a batch of them, from rotation matrices ``(..., 3, 3)`` and translations ``(..., 3)``."""
    if is_single(R, 2):
        return Pose(translation, quaternion_of(R))
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    return Pose(translation, rotation_matrix_to_quaternion(R))


def rotation_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle in radians between the rotations of two quaternions ``(..., 4)``; smooth away from zero and pi."""
    a, b = functional.normalize(a, dim=-1), functional.normalize(b, dim=-1)
    cosine = (a * b).sum(-1).abs()
    # atan2 keeps its gradient bounded where acos does not.
    sine = torch.linalg.vector_norm(b - torch.where((a * b).sum(-1, keepdim=True) < 0, -a, a), dim=-1)
    half = torch.atan2(sine * torch.sqrt((1 - sine.square() / 4).clamp_min(0.0)), cosine)
    return 2 * half


def extrapolate(before: Pose, last: Pose, steps: float = 1.0) -> Pose:
    """Constant velocity: repeat the motion from ``before`` to ``last``, ``steps`` times.

    The velocity is kept in camera coordinates, for rotation and translation separately.
    """
    delta_R = last.R @ before.R.transpose(-1, -2)
    angle_axis = _log(delta_R) * steps
    R = rotation_exponential(angle_axis) @ last.R
    return from_matrix(R, last.translation + (last.translation - before.translation) * steps)


def _log(R: Tensor) -> Tensor:
    from kornia.geometry.conversions import rotation_matrix_to_axis_angle

    result: Tensor = rotation_matrix_to_axis_angle(R[None])[0]
    return result


def rotation_exponential(axis_angle: Tensor) -> Tensor:
    """``(..., 3, 3)`` rotations by the length of ``axis_angle`` ``(..., 3)``, in radians, about it."""
    from kornia.geometry.conversions import axis_angle_to_rotation_matrix

    result: Tensor = axis_angle_to_rotation_matrix(axis_angle.reshape(-1, 3))
    return result.reshape(*axis_angle.shape, 3)


def rotation_about(axis: Tensor, degrees: float) -> Tensor:
    """``(3, 3)`` rotation about ``axis`` ``(3,)``."""
    return rotation_exponential(functional.normalize(axis, dim=0) * math.radians(degrees))
