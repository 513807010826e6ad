"""Poses as translation and unit quaternion (w, x, y, z); conversions are kornia's, or give the same digits.

``T_cam_obj`` maps object to camera coordinates: ``x_cam = R x_obj + t``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True, eq=False)
class Pose:
    """One pose, or a batch of them."""

    translation: Tensor  # (..., 3)
    quaternion: Tensor  # (..., 4), w first, unit length

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
            return self._single_R
        from kornia.geometry.conversions import quaternion_to_rotation_matrix

        result: Tensor = quaternion_to_rotation_matrix(self.quaternion)
        return result

    def matrix(self) -> Tensor:
        """``(4, 4)`` float64 ``T_cam_obj`` of a single pose, on the CPU."""
        return self._single_matrix.clone()

    # A pose of the map is asked for these in every frame.
    @cached_property
    def viewing_direction(self) -> NDArray[np.float64]:
        """``(3,)`` unit vector from the object's origin to the camera, in object coordinates, of a single pose."""
        R, t = pose_arrays(self)
        direction = -R.T @ t
        return np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-9))

    @cached_property
    def _single_R(self) -> Tensor:
        return matrix_of(self.quaternion)

    @cached_property
    def _single_matrix(self) -> Tensor:
        T_cam_obj = torch.eye(4, dtype=torch.float64)
        T_cam_obj[:3, :3] = Pose(self.translation, self.quaternion.detach().double().cpu()).R
        T_cam_obj[:3, 3] = self.translation.detach()
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


def pose_arrays(pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rotation ``(3, 3)`` and translation ``(3,)`` in float64."""
    T_cam_obj = pose.matrix().numpy()
    return T_cam_obj[:3, :3], T_cam_obj[:3, 3]


def pose_from_arrays(R: NDArray[np.float64], t: NDArray[np.float64], like: Tensor) -> Pose:
    """A pose from arrays."""
    return from_matrix(
        torch.from_numpy(np.ascontiguousarray(R)).to(like), torch.from_numpy(np.ascontiguousarray(t)).to(like)
    )


# One rotation that nobody differentiates through, converted with plain numbers.
#
# A solver converts thousands of single poses a second, and most of kornia's time for one goes into some thirty small
# tensors. The same sums and products in the same order and precision give the same digits.

_FLOOR = 1e-8  # of what a root is taken of


def is_single(values: Tensor, dimensions: int) -> bool:
    """Whether this is one rotation on the CPU that takes no part in a gradient."""
    return (
        values.ndim == dimensions
        and values.device.type == "cpu"
        and values.dtype in (torch.float32, torch.float64)
        and not (values.requires_grad and torch.is_grad_enabled())
    )


def matrix_of(quaternion: Tensor) -> Tensor:
    """``(3, 3)`` of ``(4,)``, w first, of any length; the identity if that is 0."""
    values = quaternion.detach()
    length = torch.linalg.vector_norm(values).numpy()
    if length != 0:  # NaN is passed on
        w, x, y, z = values.numpy() / max(length, length.dtype.type(1e-12))
    else:
        w, x, y, z = values.numpy()
    tx, ty, tz = x + x, y + y, z + z
    twx, twy, twz = tx * w, ty * w, tz * w
    txx, txy, txz = tx * x, ty * x, tz * x
    tyy, tyz, tzz = ty * y, tz * y, tz * z
    one = x.dtype.type(1)
    rows = [
        [one - (tyy + tzz), txy - twz, txz + twy],
        [txy + twz, one - (txx + tzz), tyz - twx],
        [txz - twy, tyz + twx, one - (txx + tyy)],
    ]
    return torch.from_numpy(np.array(rows, x.dtype))


def quaternion_of(R: Tensor) -> Tensor:
    """``(4,)``, w first, of ``(3, 3)``."""
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = R.detach().numpy()
    one, quarter = m00.dtype.type(1), m00.dtype.type(0.25)
    trace = m00 + m11 + m22
    if trace > 0:
        root = _twice_root(trace + one)
        quaternion = quarter * root, *_over(root, m21 - m12, m02 - m20, m10 - m01)
    elif m00 > m11 and m00 > m22:
        root = _twice_root(one + m00 - m11 - m22)
        w, y, z = _over(root, m21 - m12, m01 + m10, m02 + m20)
        quaternion = w, quarter * root, y, z
    elif m11 > m22:
        root = _twice_root(one + m11 - m00 - m22)
        w, x, z = _over(root, m02 - m20, m01 + m10, m12 + m21)
        quaternion = w, x, quarter * root, z
    else:
        root = _twice_root(one + m22 - m00 - m11)
        w, x, y = _over(root, m10 - m01, m02 + m20, m12 + m21)
        quaternion = w, x, y, quarter * root
    return torch.from_numpy(np.array(quaternion, m00.dtype))


def _twice_root(value: np.floating) -> np.floating:
    """Twice the root, of no less than a small number; NaN of NaN."""
    of = value.dtype.type
    if value <= of(_FLOOR):
        return of(2 * _FLOOR**0.5)
    [root] = (
        torch.from_numpy(np.array([value])).sqrt().numpy()
    )  # NumPy's differs from torch's in the last digit
    return of(2) * root


def _over(divisor: np.floating, *values: np.floating) -> list[np.floating]:
    return [value / divisor for value in values]
