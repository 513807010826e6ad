"""The smooth ways in which a shape can change, and equations in them: few unknowns in place of all vertices."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import eigsh
from torch import Tensor

from tracking3d.estimation.online.shaded_appearance import FaceEquations
from tracking3d.estimation.shape import Shape

MODES = 80
"""How many a fit uses; with 40 the wedge of the suite starts 4 degrees off, with 80 1 to 2."""


@dataclass(frozen=True, eq=False)
class Modes:
    """The lowest modes of a shape's Laplacian.

    Attributes:
        vectors: ``(V, M)`` float64 orthonormal columns.
        bending: ``(M,)`` squared norm of each one's Laplacian.
    """

    vectors: Tensor
    bending: Tensor

    @classmethod
    def of(cls, shape: Shape, count: int = MODES) -> Modes:
        """The ``count`` lowest."""
        laplacian = shape.laplacian.coalesce()
        rows, columns = laplacian.indices().cpu().numpy()
        L = sparse.csc_matrix(
            (laplacian.values().double().cpu().numpy(), (rows, columns)), shape=laplacian.shape
        )
        count = min(count, L.shape[0] - 1)
        bending, vectors = eigsh(L.T @ L, k=count, sigma=-1e-6, v0=np.ones(L.shape[0]))
        vectors = torch.from_numpy(np.ascontiguousarray(vectors)).to(shape.rest.device)
        return cls(vectors, torch.from_numpy(bending).clamp_min(0).to(vectors))


def in_modes(shown: FaceEquations, modes: Modes, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Matrix and gradient of face equations in ``(3 M + G)`` unknowns; a mode's three directions are neighbours.

    Args:
        shown: In the corners of faces and G further unknowns.
        modes: Of the shape.
        faces: ``(F, 3)`` of the shape.
    """
    corner = faces[shown.faces]
    vertices, count = modes.vectors.shape
    rows = corner[:, :, None].expand(-1, 3, 3).flatten().cpu().numpy()
    columns = corner[:, None].expand(-1, 3, 3).flatten().cpu().numpy()
    blocks = shown.corners.double().reshape(-1, 3, 3, 3, 3).cpu().numpy()  # (N, corner, xyz, corner, xyz)
    basis = modes.vectors.cpu().numpy()
    shape = np.zeros((count, 3, count, 3))
    for i in range(3):
        for j in range(i, 3):
            entries = sparse.csr_matrix(
                (blocks[:, :, i, :, j].ravel(), (rows, columns)), shape=(vertices, vertices)
            )
            part = basis.T @ (entries @ basis)
            shape[:, i, :, j], shape[:, j, :, i] = part, part.T
    at_corners = torch.cat([shown.mixed, shown.by_corners[..., None]], 2)
    width = at_corners.shape[2]
    at_vertices = at_corners.new_zeros(vertices, 3 * width).index_add(
        0, corner.flatten(), at_corners.reshape(-1, 3 * width)
    )
    mixed = (modes.vectors.to(at_vertices).T @ at_vertices).reshape(3 * count, width).double()
    top = torch.cat([torch.from_numpy(shape.reshape(3 * count, 3 * count)).to(mixed), mixed[:, :-1]], 1)
    bottom = torch.cat([mixed[:, :-1].T, shown.rest.double()], 1)
    return torch.cat([top, bottom]), torch.cat([mixed[:, -1], shown.by_rest.double()])
