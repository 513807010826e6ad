"""The part of an object that does not change while it is estimated, and the flat prior."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tracking3d.geometry.mesh import Mesh, uniform_laplacian


@dataclass(frozen=True, eq=False)
class Shape:
    """The fixed part of the object: prototype, topology and atlas.

    Attributes:
        rest: ``(V, 3)`` vertices of the prototype.
        faces: ``(F, 3)`` int64.
        face_uvs: ``(F, 3, 2)``.
        laplacian: Sparse ``(V, V)``.
        flat: Whether all vertices stay in one plane.
    """

    rest: Tensor
    faces: Tensor
    face_uvs: Tensor
    laplacian: Tensor
    flat: bool

    @classmethod
    def of(cls, mesh: Mesh, flat: bool, device: torch.device) -> Shape:
        """Take a prototype mesh to a device."""
        faces = torch.from_numpy(mesh.faces).to(device)
        laplacian = uniform_laplacian(faces, len(mesh.vertices)).to(device)
        return cls(
            torch.from_numpy(mesh.vertices).float().to(device),
            faces,
            torch.from_numpy(mesh.face_uvs).float().to(device),
            laplacian,
            flat,
        )


def flatten(vertices: Tensor) -> Tensor:
    """Project ``(V, 3)`` onto their best-fitting plane: the flat prior (paper section 4.2)."""
    centre = vertices.mean(0)
    _, _, axes = torch.linalg.svd(vertices - centre, full_matrices=False)
    normal = axes[2]
    return vertices - ((vertices - centre) @ normal)[:, None] * normal
