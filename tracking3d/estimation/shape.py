"""The part of an object that does not change while it is estimated, and priors of its shape: flat, not folded."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tracking3d.geometry.mesh import Mesh, uniform_laplacian

_MAX_FOLDED = 0.01  # share of the surface's area that may be folded (chosen)
_MAX_ROUNDS = 12  # of smoothing a fold (chosen)


@dataclass(frozen=True, eq=False)
class Shape:
    """The fixed part of the object: prototype, topology and atlas."""

    rest: Tensor  # (V, 3) vertices of the prototype
    faces: Tensor  # (F, 3) int64
    face_uvs: Tensor  # (F, 3, 2)
    laplacian: Tensor  # sparse (V, V)
    flat: bool  # whether all vertices stay in one plane

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


def unfold(shape: Shape, vertices: Tensor) -> Tensor:
    """The surface of an object without points, with its folds smoothed away.

    A folded surface fits any outline, and any sense of turning. A face that looks at the middle of the surface belongs
    to a fold or to a cavity, and without points nothing measures the depth of a cavity. Vertices of such faces are
    moved to the mean of their neighbours, until hardly any of the surface is folded.

    Args:
        shape: The topology.
        vertices: ``(V, 3)``.
    """
    if shape.flat:
        return vertices
    for _ in range(_MAX_ROUNDS):
        a, b, c = vertices[shape.faces].unbind(1)
        normal, centre = torch.linalg.cross(b - a, c - a), (a + b + c) / 3
        area = normal.norm(dim=1)
        middle = (centre * area[:, None]).sum(0) / area.sum()
        inward = ((centre - middle) * normal).sum(1) < 0
        if float((inward * area).sum()) <= _MAX_FOLDED * float(area.sum()):
            break
        moved = torch.zeros(len(vertices), dtype=torch.bool, device=vertices.device)
        moved[shape.faces[inward].flatten()] = True
        vertices = torch.where(moved[:, None], vertices - shape.laplacian @ vertices, vertices)
    return vertices
