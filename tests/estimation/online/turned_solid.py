"""A map whose keyframes show a solid that turns about the upright axis, drawn by the renderer itself."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.shape import Shape
from tracking3d.geometry.camera import Camera, Window
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.geometry.prototypes import ellipsoid
from tracking3d.rendering import TexelMap, render

SIZE = 64
CAMERA = Camera.from_fov(SIZE, SIZE)
LAMP = torch.tensor([[0.3, -0.2, -0.3], [0.2, -0.3, -0.2], [0.1, -0.1, -0.4]])
"""What each channel gains by the normal."""


def turned(degrees: float, depth: float = 3.4) -> Pose:
    """The solid turned about the upright axis."""
    return from_matrix(
        rotation_about(torch.tensor([0.0, 1.0, 0.0]), degrees), torch.tensor([0.0, 0.0, depth])
    )


def spots(points: Tensor) -> Tensor:
    """``(N, 3)`` colours that vary over the surface."""
    return 0.5 + 0.35 * torch.stack(
        [torch.sin(5 * points[:, 0]), torch.sin(6 * points[:, 1] + 1), torch.sin(5 * points[:, 2] - 1)], 1
    )


def turned_map(angles: list[float], *, textured: bool = True, lit: bool = True, step: int = 2) -> ObjectMap:
    """Keyframes at the true poses over the true shape; the shape's rest is a rounder prototype."""
    rest = ellipsoid(np.array([0.8, 0.8, 0.8]), np.eye(3), 6)
    shape = Shape.of(rest, False, torch.device("cpu"))
    stretched = shape.rest * torch.tensor([1.0, 0.8, 0.65])
    # Lopsided: a symmetric solid would not show by its outline which way it turns.
    vertices = stretched + 0.15 * torch.sin(3 * stretched[:, :1]) * torch.tensor([[0.0, 1.0, 0.4]])
    window = Window(0, 0, SIZE, SIZE)
    views = []
    for number, angle in enumerate(angles):
        pose = turned(angle)
        features, mask = _picture(vertices, shape, pose, window, textured, lit)
        observation = Observation(
            number * step, window, torch.tensor(window.K(CAMERA)).float(), features, features,
            torch.ones(SIZE, SIZE), mask, torch.zeros(SIZE, SIZE), True,
        )  # fmt: skip
        views.append(Keyframe(observation, mask.numpy() > 0.5, pose, FollowedPoints.none()))
    texels = TexelMap.of(shape.face_uvs, 48)
    return ObjectMap(shape, texels, vertices, np.zeros((0, 3)), tuple(views), np.zeros(0, dtype=np.bool_))


def _picture(
    vertices: Tensor, shape: Shape, pose: Pose, window: Window, textured: bool, lit: bool
) -> tuple[Tensor, Tensor]:
    K = torch.tensor(window.K(CAMERA)).float()
    drawn = render(
        vertices, shape.faces, shape.face_uvs, torch.zeros(1, 8, 8), pose.R[None], pose.translation[None], K[None],
        (window.size, window.size),
    )  # fmt: skip
    on_object = (drawn.points - pose.translation) @ pose.R
    colour = spots(on_object) if textured else torch.full_like(on_object, 0.5)
    if lit:
        colour = colour + drawn.normals @ LAMP.T
    mask = (drawn.face_index[0] >= 0).float()
    # Around the object its own mean, so that no edge of the background is taken for texture.
    return torch.where(mask > 0, drawn.image(colour)[0], colour.mean(0)[:, None, None]), mask


def degrees_apart(a: Pose, b: Pose) -> float:
    """Angle between two poses' rotations."""
    cosine = (float(torch.trace(a.R @ b.R.T)) - 1) / 2
    return math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
