"""Moves the surface with its landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from tracking3d.points.view import Array

_STAY = 1e-3  # weight that holds every vertex, so that there is one answer


def move_surface(
    vertices: Array,
    faces: NDArray[np.int64],
    face: NDArray[np.int64],
    barycentric: Array,
    landmarks: Array,
    stiffness: float = 1.0,
) -> Array:
    """Move a mesh so that points on it come to lie on their landmarks.

    The movement is smooth (its Laplacian is small) and robust: a landmark much further off than most counts little.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        face: ``(N,)`` the face that each point lies on.
        barycentric: ``(N, 3)`` where on it.
        landmarks: ``(N, 3)``.
        stiffness: Weight of the smoothness.

    Returns:
        ``(V, 3)`` vertices.
    """
    count = len(face)
    if not count:
        return vertices
    rows = np.repeat(np.arange(count), 3)
    on = sparse.csr_matrix((barycentric.ravel(), (rows, faces[face].ravel())), shape=(count, len(vertices)))
    gap = landmarks - on @ vertices
    length = np.linalg.norm(gap, axis=1)
    weight = 1 / (1 + (length / (3 * np.median(length) + 1e-12)) ** 2)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    joined = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2).tocsr()
    joined = ((joined + joined.T) > 0).astype(float)
    neighbours = np.maximum(np.asarray(joined.sum(1)).ravel(), 1)
    laplacian = sparse.eye(len(vertices)) - sparse.diags(1 / neighbours) @ joined
    H = (
        on.T @ sparse.diags(weight) @ on
        + stiffness * (laplacian.T @ laplacian)
        + _STAY * sparse.eye(len(vertices))
    )
    moved: Array = vertices + spsolve(H.tocsc(), on.T @ (weight[:, None] * gap))
    return moved
