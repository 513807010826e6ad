"""The differentiable renderer as modules that take kornia's cameras and poses and give ``(B, C, H, W)`` tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.geometry.liegroup import Se3
from kornia.geometry.quaternion import Quaternion
from numpy.typing import ArrayLike
from torch import Tensor, nn

from tracking3d.errors import InputError
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import Rendering, SoftBand, rasterize, render, soft_silhouette
from tracking3d.rendering.renderer import to_camera, to_screen


class TexturedMesh(nn.Module):
    """A mesh whose vertices and texture can be learnt.

    Args:
        vertices: ``(V, 3)`` in object coordinates; a parameter.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside.
        face_uvs: ``(F, 3, 2)``, one per face corner; v runs down the texture, u wraps at 1.
        texture: ``(C, T, T)``; a parameter.
    """

    faces: Tensor
    face_uvs: Tensor

    def __init__(self, vertices: Tensor, faces: Tensor, face_uvs: Tensor, texture: Tensor) -> None:
        super().__init__()
        self.vertices = nn.Parameter(vertices.detach().clone())
        self.texture = nn.Parameter(texture.detach().clone())
        self.register_buffer("faces", faces.detach().clone())
        self.register_buffer("face_uvs", face_uvs.detach().clone())

    @classmethod
    def of(cls, mesh: Mesh, texture: Tensor) -> Self:
        """A mesh such as `tracking3d.geometry.prototypes.sphere` with a texture ``(C, T, T)``, of the same type."""
        vertices, face_uvs = (torch.tensor(part).to(texture) for part in (mesh.vertices, mesh.face_uvs))
        return cls(vertices, torch.tensor(mesh.faces, device=texture.device), face_uvs, texture)

    def forward(self) -> tuple[Tensor, Tensor]:
        """Vertices and texture."""
        return self.vertices, self.texture


@dataclass(frozen=True, eq=False)
class RenderedViews:
    """What a mesh looks like in B frames."""

    image: Tensor  # (B, C, H, W) texture, zero where uncovered
    silhouette: Tensor  # (B, 1, H, W) soft, in [0, 1]
    drawn: Rendering  # all that the renderer returns

    @property
    def depth(self) -> Tensor:
        """``(B, 1, H, W)`` z in camera coordinates, zero where uncovered; differentiable."""
        return self.drawn.image(self.drawn.points[:, 2:])


class MeshRenderer(nn.Module):
    """Draws a textured mesh; differentiable in vertices, texture, poses and cameras, see `tracking3d.rendering.render`.

    Args:
        band: Kernel of the soft silhouette; DIB-R's constants if None.
        backend: ``auto``, ``torch`` or ``numba``, see `tracking3d.rendering.backend`.
    """

    def __init__(self, band: SoftBand | None = None, backend: str = "auto") -> None:
        super().__init__()
        self.band, self.backend = band or SoftBand(), backend

    def forward(self, mesh: TexturedMesh, camera: PinholeCamera, pose: Se3) -> RenderedViews:
        """Draw the mesh.

        Args:
            mesh: The mesh.
            camera: Camera of each frame, or one for all; all of one size. Its extrinsics follow the pose: where they
                are the identity the pose maps object to camera, else object to world.
            pose: Pose of each of B frames, or one for all.

        Raises:
            ValueError: If cameras and poses are not as many, sizes differ, or a camera has a skew.
        """
        R, t, K, size = _frames(camera, pose)
        vertices, texture = mesh()
        drawn = render(
            vertices, mesh.faces, mesh.face_uvs, texture, R, t, K, size, self.band, self.backend
        )  # fmt: skip
        return RenderedViews(drawn.image(), drawn.silhouette[:, None], drawn)

    def extra_repr(self) -> str:
        """Band and backend."""
        return f"band={self.band}, backend={self.backend!r}"


class Silhouette(nn.Module):
    """Draws the soft silhouette alone, see `tracking3d.rendering.soft_silhouette`.

    Args:
        band: Its kernel; DIB-R's constants if None.
        backend: See `MeshRenderer`.
    """

    def __init__(self, band: SoftBand | None = None, backend: str = "auto") -> None:
        super().__init__()
        self.band, self.backend = band or SoftBand(), backend

    def forward(self, vertices: Tensor, faces: Tensor, camera: PinholeCamera, pose: Se3) -> Tensor:
        """``(B, 1, H, W)`` in [0, 1]; differentiable in vertices, poses and cameras.

        Args:
            vertices: ``(V, 3)``, or ``(B, V, 3)`` with one mesh a frame.
            faces: ``(F, 3)`` int64.
            camera: See `MeshRenderer`.
            pose: See `MeshRenderer`.

        Raises:
            ValueError: As there.
        """
        R, t, K, size = _frames(camera, pose)
        x_cam = to_camera(vertices, R, t)
        screen, depth = to_screen(x_cam, K), x_cam[..., 2]
        index = rasterize(screen, depth, faces, size, self.backend).face_index
        band = self.band
        soft = soft_silhouette(
            screen, depth, faces, index, band.sigma, band.boxlen, band.knum, self.backend
        )  # fmt: skip
        return soft[:, None]

    def extra_repr(self) -> str:
        """Band and backend."""
        return f"band={self.band}, backend={self.backend!r}"


def _frames(camera: PinholeCamera, pose: Se3) -> tuple[Tensor, Tensor, Tensor, tuple[int, int]]:
    """``(B, 3, 3)`` rotations and ``(B, 3)`` translations to the camera, ``(B, 3, 3)`` intrinsics, and the size."""
    matrix: Tensor = pose.matrix()
    matrix = matrix[None] if matrix.dim() == 2 else matrix
    K, extrinsics = camera.intrinsics[:, :3, :3], camera.extrinsics
    views = max(len(matrix), len(K))
    if len(matrix) not in (1, views) or len(K) not in (1, views):
        raise ValueError(
            f"camera has {len(K)} frames and pose {len(matrix)}; give as many of both, or one of either"
        )
    if K.detach()[:, [0, 1], [1, 0]].any():
        raise ValueError("camera has a skew, which is not rendered; give fx, fy, cx and cy alone")
    sizes = {(int(height), int(width)) for height, width in zip(camera.height, camera.width, strict=True)}
    if len(sizes) > 1:
        raise ValueError(f"camera has frames of the sizes {sorted(sizes)}; draw those of one size at a time")
    T = extrinsics @ matrix
    return (
        T[:, :3, :3].expand(views, 3, 3).contiguous(),
        T[:, :3, 3].expand(views, 3).contiguous(),
        K.expand(views, 3, 3).contiguous(),
        sizes.pop(),
    )


# Our camera and poses as kornia's, and back.
#
# Both have OpenCV's axes, pixel (0, 0) at the centre of the top-left pixel, and quaternions with w first; a pose maps
# object to camera, as an `Se3` of kornia's does when it is applied to object points. Everything is differentiable.


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
