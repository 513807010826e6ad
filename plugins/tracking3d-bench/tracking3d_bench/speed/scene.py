"""What the benchmark of the renderer renders, and the loss that every backend evaluates of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from kornia.geometry.conversions import axis_angle_to_rotation_matrix
from torch import Tensor

from tracking3d.estimation.paper import problem
from tracking3d.geometry.prototypes import sphere
from tracking3d.rendering import Rendering, channels_last, texture_losses

Backend = Callable[..., Rendering]
"""Called with the arguments of `tracking3d.rendering.render`, by name."""

_CAUCHY_SCALE, _TOTAL_VARIATION_WEIGHT = 0.25, 0.001


def default_texture(channels: int) -> int:
    """Side of the texture that solvers give to RGB, or to that many feature channels."""
    return 300 if channels <= 16 else 150


@dataclass(frozen=True)
class RenderWorkload:
    """How much there is to render."""

    size: int = 128  # side of the windows in pixels
    frames: int = 7  # frames in the batch
    channels: int = 3  # channels of the texture and of the frames
    texture: int = 300  # side of the texture in texels
    frequency: int = 11  # frequency of the icosphere

    @property
    def pixels(self) -> int:
        """Pixels of one window."""
        return self.size**2

    @property
    def faces(self) -> int:
        """Faces of the mesh."""
        return 20 * self.frequency**2


@dataclass(frozen=True, eq=False)
class RenderScene:
    """One problem: what is rendered, and what it is compared with."""

    parameters: dict[str, Tensor]  # what gets gradients: vertices, texture, R and t of `render`
    constants: dict[str, Any]  # its other arguments
    features: Tensor  # (B, C, H, W) observed
    mask: Tensor  # (B, H, W) observed

    @classmethod
    def make(cls, problem: RenderWorkload, device: torch.device) -> RenderScene:
        """An ellipsoid that turns by 10 degrees a frame and covers a quarter of the pixels."""
        size, frames, channels = problem.size, problem.frames, problem.channels
        generator = torch.Generator().manual_seed(0)
        mesh = sphere(problem.frequency)
        vertices = torch.from_numpy(mesh.vertices).float() * torch.tensor([1.0, 0.8, 0.6])
        vertices += 0.01 * torch.randn(vertices.shape, generator=generator)
        turns = torch.deg2rad(torch.tensor([[3.0, 10.0, 1.0]]) * torch.arange(frames)[:, None])
        K = torch.tensor([[1.25 * size, 0, (size - 1) / 2], [0, 1.25 * size, (size - 1) / 2], [0, 0, 1]])
        texture = torch.rand(channels, problem.texture, problem.texture, generator=generator)
        parameters = {
            "vertices": vertices,
            "texture": channels_last(texture),
            "R": axis_angle_to_rotation_matrix(turns),
            "t": torch.tensor([[0.0, 0.0, 4.0]]).repeat(frames, 1),
        }
        constants = {
            "faces": torch.from_numpy(mesh.faces).to(device),
            "face_uvs": torch.from_numpy(mesh.face_uvs).float().to(device),
            "K": K.repeat(frames, 1, 1).to(device),
            "size": (size, size),
        }
        y, x = torch.meshgrid(*[torch.linspace(-1, 1, size)] * 2, indexing="ij")
        mask = (x**2 + y**2 < 0.3).float().expand(frames, size, size)
        features = torch.rand(frames, channels, size, size, generator=generator)
        leaves = {name: value.to(device).requires_grad_() for name, value in parameters.items()}
        return cls(leaves, constants, channels_last(features).to(device), mask.to(device))

    def loss(self, backend: Backend) -> Tensor:
        """The paper's losses of the rendering by ``backend``."""
        drawn = backend(**self.parameters, **self.constants)
        valid = torch.ones_like(self.mask)
        pixel_loss, smooth = texture_losses(
            drawn.texture, drawn.uv, self.features, drawn.pixels, _CAUCHY_SCALE, backend=drawn.backend
        )
        appearance = problem.appearance_loss(pixel_loss, drawn.pixels, valid, _CAUCHY_SCALE).mean()
        silhouette = problem.iou_loss(drawn.silhouette, self.mask, valid).mean()
        return appearance + silhouette + _TOTAL_VARIATION_WEIGHT * smooth

    def forget_gradients(self) -> None:
        """Make ready for the next backward pass."""
        for parameter in self.parameters.values():
            parameter.grad = None
