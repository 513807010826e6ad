"""A triangle mesh with texture coordinates, its uniform Laplacian and its normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True, eq=False)
class Mesh:
    """Fixed topology and atlas; the vertices are the rest shape.

    Attributes:
        vertices: ``(V, 3)`` float64 in object coordinates.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside.
        face_uvs: ``(F, 3, 2)`` float64, one per face corner; v runs down the texture, u wraps at 1.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_uvs: NDArray[np.float64]


def uniform_laplacian(faces: Tensor, vertices: int) -> Tensor:
    """Sparse ``(V, V)`` matrix L with ``(L x)_i = x_i - mean of the neighbours of i`` (SoftRas).

    Args:
        faces: ``(F, 3)`` int64.
        vertices: Number of vertices V.
    """
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = torch.unique(torch.cat([directed, directed.flip(1)]), dim=0)
    degree = torch.bincount(edges[:, 0], minlength=vertices).clamp_min(1)
    diagonal = torch.arange(vertices, device=faces.device)
    index = torch.cat([edges.T, torch.stack([diagonal, diagonal])], 1)
    value = torch.cat([-1.0 / degree[edges[:, 0]], torch.ones(vertices, device=faces.device)])
    return torch.sparse_coo_tensor(index, value, (vertices, vertices), check_invariants=False).coalesce()


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals ``(..., V, 3)`` of ``(..., V, 3)``: the faces' normals, averaged by area; differentiable.

    A vertex without a face of positive area has a zero normal.

    Args:
        vertices: ``(..., V, 3)``.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside.
    """
    a, b, c = (vertices.index_select(-2, corner) for corner in faces.unbind(1))
    weighted = torch.linalg.cross(b - a, c - a)  # twice the area long
    total = torch.zeros_like(vertices)
    for corner in faces.unbind(1):
        total = total.index_add(-2, corner, weighted)
    return functional.normalize(total, dim=-1)
