"""Things to render, as ``(B, V, 2)`` screen positions, ``(B, V)`` depths and ``(F, 3)`` faces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from implementations import Implementation
from scipy.spatial.transform import Rotation
from torch import Tensor

from tracking3d.geometry.prototypes import sphere
from tracking3d.rendering import project


@dataclass(frozen=True, eq=False)
class Scene:
    """What is drawn, and into which ``(H, W)``: numbers of float32 in float64, the same for all implementations."""

    screen: Tensor
    depth: Tensor
    faces: Tensor
    size: tuple[int, int]
    backend: str = "torch"

    def by(self, implementation: Implementation) -> Scene:
        """The same for another implementation."""
        screen, depth = self.screen.to(implementation.dtype), self.depth.to(implementation.dtype)
        return replace(self, screen=screen, depth=depth, backend=implementation.backend)


def triangles(
    seed: int, size: tuple[int, int] = (24, 24), views: int = 2, faces: int = 24, spread: float = 0.3
) -> Scene:
    """Random triangles that share no vertex, of either orientation, some partly outside the picture.

    Args:
        seed: Of the random numbers.
        size: ``(H, W)``.
        views: Number of views.
        faces: Number of triangles.
        spread: Their size, as a share of the picture.
    """
    generator = torch.Generator().manual_seed(seed)
    extent = torch.tensor([size[1], size[0]], dtype=torch.float64)
    centre = torch.rand(views, faces, 1, 2, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    corner = centre + spread * torch.randn(views, faces, 3, 2, generator=generator, dtype=torch.float64)
    depth = 1 + torch.rand(views, 3 * faces, generator=generator, dtype=torch.float64)
    index = torch.arange(3 * faces).reshape(faces, 3)
    return Scene(rounded((corner * extent).reshape(views, -1, 2)), rounded(depth), index, size)


def rounded(values: Tensor) -> Tensor:
    """The nearest numbers of float32, in float64."""
    return values.float().double()


@dataclass(frozen=True, eq=False)
class Textured:
    """Everything `render` takes, in float64, for a bumpy sphere in several poses and windows."""

    vertices: Tensor
    faces: Tensor
    face_uvs: Tensor
    texture: Tensor
    R: Tensor
    t: Tensor
    K: Tensor
    size: tuple[int, int]

    @property
    def scene(self) -> Scene:
        """Its projection."""
        screen, depth = project(self.vertices, self.R, self.t, self.K)
        return Scene(rounded(screen), rounded(depth), self.faces, self.size)

    def arguments(self, dtype: torch.dtype = torch.float64, device: str = "cpu") -> dict[str, Tensor]:
        """The tensors by name, fresh leaves of an autograd graph."""
        names = ("vertices", "face_uvs", "texture", "R", "t", "K")
        return {name: getattr(self, name).to(device, dtype, copy=True).requires_grad_() for name in names}


def rotations(vectors: list[list[float]]) -> Tensor:
    """``(B, 3, 3)`` from rotation vectors in degrees."""
    return torch.tensor(Rotation.from_rotvec(vectors, degrees=True).as_matrix())


def bumpy_sphere(
    size: tuple[int, int] = (40, 40), views: int = 2, frequency: int = 4, texture: int = 24, channels: int = 3
) -> Textured:
    """A dented ellipsoid with a smooth texture; every view has its own pose and window."""
    generator = torch.Generator().manual_seed(3)
    mesh = sphere(frequency)
    unit = torch.tensor(mesh.vertices)
    bumps = 1 + 0.15 * torch.sin(3 * unit[:, :1] + 1) * torch.cos(4 * unit[:, 1:2])
    turns = [[20.0 * view - 10, 50.0 * view, 5.0] for view in range(views)]
    offsets = torch.rand(views, 3, generator=generator, dtype=torch.float64) * 0.3 - 0.15
    K = torch.eye(3, dtype=torch.float64).repeat(views, 1, 1)
    K[:, 0, 0] = K[:, 1, 1] = 1.25 * min(size) + torch.arange(views)
    K[:, 0, 2], K[:, 1, 2] = (size[1] - 1) / 2 + 0.37, (size[0] - 1) / 2 - 0.21
    return Textured(
        unit * bumps * torch.tensor([1.0, 0.8, 0.7], dtype=torch.float64),
        torch.tensor(mesh.faces),
        torch.tensor(mesh.face_uvs),
        waves(texture, channels),
        rotations(turns),
        torch.tensor([0.0, 0.0, 3.5], dtype=torch.float64) + offsets,
        K,
        size,
    )


def waves(size: int, channels: int = 3) -> Tensor:
    """A smooth texture ``(C, T, T)`` in [0, 1] that goes on across the seam and has no two places alike."""
    v, u = torch.meshgrid(*[(torch.arange(size, dtype=torch.float64) + 0.5) / size] * 2, indexing="ij")
    layers = [
        torch.sin(2 * torch.pi * (1 + channel % 3) * u + channel) * torch.cos(3 * v + 2 * channel) + 0.4 * v
        for channel in range(channels)
    ]
    return 0.5 + 0.35 * torch.stack(layers)
