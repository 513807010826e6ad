"""The smooth ways in which a shape can change: few unknowns in place of all vertices."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import eigsh
from torch import Tensor

from tracking3d.estimation.shape import Shape

MODES = 80
"""How many a fit uses; with 40 the wedge of the suite starts 4 degrees off, with 80 1 to 2."""
_LARGEST_GROUP = 16  # modes that share an eigenvalue; an icosahedron has at most 5 by its symmetry
_SAME = 1e-7  # eigenvalues that differ by a smaller share are one; rounding makes differences of 1e-12


@dataclass(frozen=True, eq=False)
class ShapeBasis:
    """The lowest modes of a shape's Laplacian."""

    vectors: Tensor  # (V, M) float64 orthonormal columns
    bending: Tensor  # (M,) squared norm of each one's Laplacian

    @classmethod
    def of(cls, shape: Shape, count: int = MODES) -> ShapeBasis:
        """The ``count`` lowest, and those that share the last one's bending."""
        laplacian = shape.laplacian.coalesce()
        rows, columns = laplacian.indices().cpu().numpy()
        L = sparse.csc_matrix(
            (laplacian.values().double().cpu().numpy(), (rows, columns)), shape=laplacian.shape
        )
        values, columns = _lowest_modes((L.T @ L).tocsc(), count)
        vectors = torch.from_numpy(np.ascontiguousarray(columns)).to(shape.rest.device)
        return cls(vectors, torch.from_numpy(values).to(vectors))


def _lowest_modes(matrix: sparse.csc_matrix, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The lowest eigenvalues of a positive semidefinite matrix and their vectors, the same on every machine.

    A sphere's modes come in groups that share an eigenvalue. Where one is cut, or which of its bases is taken, would
    be up to rounding, and the fit with it: groups are taken whole, and each has the one basis that a fixed set of
    vectors has in it.

    Returns:
        ``(M,)`` eigenvalues and ``(V, M)`` orthonormal columns; M is ``count`` or the least above that cuts no group.
    """
    size = matrix.shape[0]
    generator = np.random.default_rng(0)
    # Not a vector of ones: that is a mode itself, and the search would go on from rounding.
    values, vectors = eigsh(
        matrix, k=min(count + _LARGEST_GROUP, size - 1), sigma=-1e-6, v0=generator.standard_normal(size)
    )
    order = np.argsort(values)
    values, vectors = values[order].clip(0), vectors[:, order]
    ends = [*(np.flatnonzero(np.diff(values) > _SAME * values[1:]) + 1), len(values)]
    ends = ends[: int(np.searchsorted(ends, min(count, len(values)))) + 1]
    for start, end in pairwise([0, *ends]):
        fixed = np.random.default_rng(start).standard_normal((size, end - start))
        turn, signed = np.linalg.qr(vectors[:, start:end].T @ fixed)
        vectors[:, start:end] = vectors[:, start:end] @ (turn * np.sign(np.diag(signed)))
        values[start:end] = values[start:end].mean()
    return values[: ends[-1]], vectors[:, : ends[-1]]
