"""Solids whose masks and images are known exactly, because they are rendered."""

from __future__ import annotations

import math

import numpy as np
import torch
import trimesh
from torch import Tensor

from tracking3d.estimation.observation import Observation, mask_distance
from tracking3d.estimation.shape import Shape
from tracking3d.geometry.camera import Window
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.geometry.prototypes import ellipsoid
from tracking3d.rendering import Rendering, Surface, render

SIZE = 64
AXES = (0.9, 0.7, 0.6)


def shape_of(axes: tuple[float, float, float] = AXES, frequency: int = 6) -> Shape:
    """An ellipsoid."""
    return Shape.of(ellipsoid(np.array(axes), np.eye(3), frequency), False, torch.device("cpu"))


def box(extents: tuple[float, float, float] = (1.2, 0.9, 0.8)) -> tuple[Tensor, Tensor]:
    """Vertices and faces."""
    mesh = trimesh.creation.box(extents)
    return torch.tensor(np.array(mesh.vertices)).float(), torch.tensor(np.array(mesh.faces))


def intrinsics(size: int = SIZE) -> Tensor:
    """``(3, 3)`` of a window in which a solid of radius 1 at depth 3.5 is about 0.7 as large."""
    focal, centre = 1.25 * size, (size - 1) / 2
    return torch.tensor([[focal, 0, centre], [0, focal, centre], [0, 0, 1]])


def pose_of(
    degrees: float = 0.0, axis: tuple[float, float, float] = (0.2, 1.0, 0.1), z: float = 3.5, x: float = 0.0
) -> Pose:
    """Turned about an axis, at ``(x, 0, z)``."""
    direction = torch.tensor(axis) / math.sqrt(sum(part**2 for part in axis))
    return from_matrix(rotation_about(direction, degrees), torch.tensor([x, 0.0, z]))


def poses_around() -> list[Pose]:
    """Ten poses that show the solid from all around, a few from above."""
    side = [pose_of(45 * n, (0, 1, 0), x=0.05 * n) for n in range(8)]
    return [*side, pose_of(60, (1, 0, 0)), pose_of(-60, (1, 0, 0))]


def waves(size: int = 48) -> Tensor:
    """A smooth texture ``(3, T, T)`` that has no two places alike and goes on across the seam."""
    v, u = torch.meshgrid(*[(torch.arange(size) + 0.5) / size] * 2, indexing="ij")
    turn = 2 * math.pi * u
    layers = [
        torch.sin(3 * turn) * torch.sin(9 * v),
        torch.cos(4 * turn + 7 * v),
        torch.cos(turn) * torch.sin(5 * v) + 0.5 * torch.cos(5 * turn),
    ]
    return 0.5 + 0.3 * torch.stack(layers)


def drawn(vertices: Tensor, faces: Tensor, poses: list[Pose], size: int = SIZE) -> Rendering:
    """A mesh without texture in several poses."""
    batch = Pose.stack(poses)
    uvs, K = vertices.new_zeros(len(faces), 3, 2), intrinsics(size).to(vertices).repeat(len(poses), 1, 1)
    R, t = batch.R.to(vertices), batch.translation.to(vertices)
    return render(vertices, faces, uvs, vertices.new_zeros(1, 4, 4), R, t, K, (size, size))


def silhouettes(vertices: Tensor, faces: Tensor, poses: list[Pose], size: int = SIZE) -> Tensor:
    """``(B, S, S)`` masks, 0 or 1."""
    return (drawn(vertices, faces, poses, size).face_index >= 0).float()


def mean_iou(a: Tensor, b: Tensor) -> float:
    """Of two stacks of masks."""
    return float(((a * b).sum((1, 2)) / torch.maximum(a, b).sum((1, 2))).mean())


def surface_of(shape: Shape, texture: Tensor | None = None) -> Surface:
    """The undeformed shape, seen all over."""
    texture = waves() if texture is None else texture
    return Surface(shape.rest, shape.faces, shape.face_uvs, texture, torch.ones_like(texture[:1]))


def observed(surface: Surface, pose: Pose, has_mask: bool = True, size: int = SIZE) -> Observation:
    """What a perfect camera sees of a surface in grey surroundings."""
    K = intrinsics(size)
    view = render(
        surface.vertices, surface.faces, surface.face_uvs, surface.texture, pose.R[None], pose.translation[None],
        K[None], (size, size),
    )  # fmt: skip
    covered = (view.face_index[0] >= 0).float()
    image = view.image()[0] + 0.5 * (1 - covered)
    mask = covered * has_mask
    fine = torch.nn.functional.interpolate(image[None], scale_factor=2.0)[0]
    everywhere = torch.ones(size, size)
    return Observation(
        3, Window(0, 0, size, size), K, fine, image, everywhere, mask, mask_distance(mask), has_mask
    )
