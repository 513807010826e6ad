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
    fx, fy, cx, cy, tx, ty, tz = torch.tensor(
        [camera.fx, camera.fy, camera.cx, camera.cy, 0.0, 0.0, 0.0], dtype=dtype, device=device
    )
    return PinholeCamera.from_parameters(
        fx, fy, cx, cy, camera.height, camera.width, tx, ty, tz, views, device, dtype
    )


def camera_from_pinhole(pinhole: PinholeCamera, view: int = 0) -> Camera:
    """One of kornia's cameras as ours; its extrinsics are no part of it, see `MeshRenderer`.

    Raises:
        InputError: If it has a skew, or no whole size.
    """
    fx, fy, cx, cy, height, width = (
        float(values[view])
        for values in (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, pinhole.height, pinhole.width)
    )
    (_, skew, _), (other, _, _), _ = pinhole.camera_matrix[view].tolist()
    if abs(skew) + abs(other) > 1e-6 * abs(fx):
        raise InputError(f"pinhole= has a skew of {skew:g}, and cameras here have none.")
    if not (height == int(height) > 0 and width == int(width) > 0):
        raise InputError(f"pinhole= is {width:g} x {height:g} pixels; give a whole size.")
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
    unit: Tensor = quaternion.normalize().data
    return unit
