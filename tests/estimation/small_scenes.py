"""A small textured object whose every observation is known exactly, because it is rendered."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from tracking3d.config.models import PaperConfig
from tracking3d.estimation.observation import Observation, ObservationBatch, mask_distance
from tracking3d.estimation.paper.problem import Parameters, Problem
from tracking3d.estimation.shape import Shape
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.mesh import Mesh
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.geometry.prototypes import ellipsoid
from tracking3d.rendering import render

SIZE = 48
AXES = np.array([0.9, 0.7, 0.6])


def pose_of(
    degrees: float = 0.0, x: float = 0.0, z: float = 3.0, axis: tuple[float, ...] = (0, 1, 0)
) -> Pose:
    """Turned by ``degrees`` about ``axis``, at ``(x, 0, z)``."""
    R = rotation_about(torch.tensor(axis, dtype=torch.float32), degrees)
    return from_matrix(R, torch.tensor([x, 0.0, z]))


def small_shape(flat: bool = False) -> Shape:
    """An ellipsoid of 92 vertices."""
    return Shape.of(small_mesh(), flat, torch.device("cpu"))


def small_mesh() -> Mesh:
    """The mesh of `small_shape`."""
    return ellipsoid(AXES, np.eye(3), 3)


def painted(size: int = 24) -> Tensor:
    """A smooth texture ``(3, T, T)`` without repetition."""
    v, u = torch.meshgrid(*[(torch.arange(size) + 0.5) / size] * 2, indexing="ij")
    turn = 2 * math.pi * u
    layers = [torch.sin(turn) * torch.sin(3 * v), torch.cos(2 * turn + 4 * v), torch.cos(turn) * v]
    return 0.5 + 0.4 * torch.stack(layers)


def observed(pose: Pose, index: int = 0, has_mask: bool = True, size: int = SIZE) -> Observation:
    """What a perfect camera sees of the painted object in black surroundings."""
    shape, window = small_shape(), Window(0, 0, size, size)
    K = torch.tensor(window.K(Camera.from_fov(size, size)), dtype=torch.float32)
    R, t = pose.R[None], pose.translation[None]
    drawn = render(shape.rest, shape.faces, shape.face_uvs, painted(), R, t, K[None], (size, size))
    mask = (drawn.face_index[0] >= 0).float() * has_mask
    image = drawn.image()[0]
    return Observation(
        index,
        window,
        K,
        torch.nn.functional.interpolate(image[None], scale_factor=2.0)[0],
        image,
        torch.ones(size, size),
        mask,
        mask_distance(mask),
        has_mask,
    )


def parameters_of(poses: list[Pose], texture: Tensor | None = None) -> Parameters:
    """The undeformed object in the given poses."""
    stacked = Pose.stack(poses)
    texture = painted() if texture is None else texture
    return Parameters(stacked.translation, stacked.quaternion, torch.zeros_like(small_shape().rest), texture)


def problem_of(observations: list[Observation], flat: bool = False, **solver: object) -> Problem:
    """The problem of explaining observations, with settings of the section ``solver``."""
    return Problem(small_shape(flat), ObservationBatch.of(observations), PaperConfig.model_validate(solver))
