"""Our camera and poses as kornia's, and back.

Both have OpenCV's axes, pixel (0, 0) at the centre of the top-left pixel, and quaternions with w first; a pose maps
object to camera, as an `Se3` of kornia's does when it is applied to object points. Everything is differentiable.
"""

from __future__ import annotations

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from kornia.geometry.quaternion import Quaternion
from numpy.typing import ArrayLike
from torch import Tensor

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose


def pinhole_of_camera(
    camera: Camera,
    views: int = 1,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
) -> PinholeCamera:
    """The camera as kornia's, once for each of ``views`` frames; its extrinsics are the identity."""
    intrinsics = torch.eye(4, dtype=dtype, device=device)
    intrinsics[:3, :3] = torch.tensor(camera.K, dtype=dtype, device=device)
    size = torch.tensor([[camera.height], [camera.width]], dtype=dtype, device=device).expand(2, views)
    extrinsics = torch.eye(4, dtype=dtype, device=device).expand(views, 4, 4)
    return PinholeCamera(intrinsics.expand(views, 4, 4), extrinsics, size[0], size[1])


def camera_from_pinhole(pinhole: PinholeCamera, view: int = 0) -> Camera:
    """One of kornia's cameras as ours; its extrinsics are no part of it, see `MeshRenderer`.

    Raises:
        InputError: If it has a skew, or no whole size.
    """
    K = pinhole.intrinsics[view].detach().double().cpu()
    height, width = (float(side[view]) for side in (pinhole.height, pinhole.width))
    if float(K[0, 1].abs() + K[1, 0].abs()) > 1e-6 * float(K[0, 0].abs()):
        raise InputError(f"pinhole= has a skew of {float(K[0, 1]):g}, and cameras here have none.")
    if not (height == int(height) > 0 and width == int(width) > 0):
        raise InputError(f"pinhole= is {width:g} x {height:g} pixels; give a whole size.")
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    return Camera(fx, fy, cx, cy, int(width), int(height), origin="kornia's PinholeCamera")


def se3_of_pose(pose: Pose) -> Se3:
    """A pose, or a batch of them, as kornia's."""
    return Se3(Quaternion(pose.quaternion), pose.translation)


def pose_from_se3(motion: Se3) -> Pose:
    """One of kornia's, or a batch of them, as our pose."""
    return Pose(motion.t, quaternion_from_kornia(motion.r.q))


def se3_from_matrix(T_cam_obj: Tensor | ArrayLike, dtype: torch.dtype = torch.float32) -> Se3:
    """``(4, 4)`` or ``(B, 4, 4)`` poses, such as those of a `tracking3d.TrackingResult`, as kornia's.

    Raises:
        InputError: If they have another shape.
    """
    matrix = torch.as_tensor(T_cam_obj).to(dtype)
    if matrix.shape[-2:] != (4, 4) or matrix.dim() not in (2, 3):
        raise InputError(f"T_cam_obj= has shape {tuple(matrix.shape)}; give (4, 4) or (B, 4, 4).")
    motion: Se3 = Se3.from_matrix(matrix)
    return motion


def quaternion_of_pose(pose: Pose) -> Quaternion:
    """The rotation of a pose as kornia's; both have w first."""
    return Quaternion(pose.quaternion)


def quaternion_from_kornia(quaternion: Quaternion) -> Tensor:
    """``(..., 4)`` of unit length, w first; kornia takes one of any length for its direction."""
    q: Tensor = quaternion.data
    return torch.nn.functional.normalize(q, dim=-1)
