"""Rays against triangle meshes with Embree; which point of which triangle, in float64.

Embree finds the triangle; where on it is worked out here, so that depth and texture coordinates are not limited
by its single precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import csr_array

from tracking3d.errors import InputError

Array = NDArray[np.float64]

_CREASE = np.cos(np.radians(45.0))
"""Neighbouring faces at a greater angle meet in a sharp edge; others are one smooth surface."""


@dataclass(frozen=True, eq=False)
class MeshHits:
    """What N rays meet first."""

    face: NDArray[np.int64]  # (N,) int64; -1 where a ray meets nothing, and what follows means nothing there
    distance: Array  # (N,) along the ray, in lengths of its direction; infinite where it meets nothing
    weights: Array  # (N, 3) barycentric coordinates


@dataclass(frozen=True, eq=False)
class RayMesh:
    """A mesh that rays are cast at."""

    vertices: Array  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3) int64
    face_normals: Array  # (F, 3) unit; zero for triangles without area
    corner_normals: Array  # (F, 3, 3) unit normals at the corners of the faces, smooth where the surface is
    intersector: Any  # trimesh's, with Embree

    @classmethod
    def of(cls, mesh: trimesh.Trimesh, vertex_normals: Array | None = None) -> RayMesh:
        """Prepare a mesh.

        Args:
            mesh: The mesh.
            vertex_normals: ``(V, 3)`` unit normals of a surface without sharp edges, if they are known.

        Raises:
            InputError: If the package embreex is not installed.
        """
        try:
            from trimesh.ray.ray_pyembree import RayMeshIntersector
        except ImportError as error:
            raise InputError(
                "Synthetic sequences need the package embreex; install it with: pip install 'tracking3d[synth]'."
            ) from error
        vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
        a, b, c = vertices[faces].transpose(1, 0, 2)
        area = np.cross(b - a, c - a)
        normals = area / np.linalg.norm(area, axis=1, keepdims=True).clip(1e-300)
        if vertex_normals is None:
            corner_normals = _corner_normals(vertices, faces, area, normals)
        else:
            corner_normals = vertex_normals[faces]
        return cls(vertices, faces, normals, corner_normals, RayMeshIntersector(mesh))

    def cast(self, origins: Array, directions: Array) -> MeshHits:
        """First hits of rays from ``origins`` along ``directions``, both ``(N, 3)``; both sides of a face count."""
        face = np.full(len(origins), -1, np.int64)
        distance = np.full(len(origins), np.inf)
        weights = np.zeros((len(origins), 3))
        if len(origins):
            face[:] = self.intersector.intersects_first(origins, directions)
        hit = np.flatnonzero(face >= 0)
        a, b, c = self.vertices[self.faces[face[hit]]].transpose(1, 0, 2)
        # Moeller and Trumbore, Fast, minimum storage ray/triangle intersection, 1997.
        d, s = directions[hit], origins[hit] - a
        ab, ac = b - a, c - a
        p, q = np.cross(d, ac), np.cross(s, ab)
        inverse = 1 / np.einsum("ij,ij->i", ab, p)
        v, w = inverse * np.einsum("ij,ij->i", s, p), inverse * np.einsum("ij,ij->i", d, q)
        distance[hit] = inverse * np.einsum("ij,ij->i", ac, q)
        # Single precision may give a triangle whose edge the exact ray just misses.
        inside = np.stack([1 - v - w, v, w], 1).clip(0)
        weights[hit] = inside / inside.sum(1, keepdims=True)
        return MeshHits(face, distance, weights)

    def is_blocked(self, origins: Array, directions: Array) -> NDArray[np.bool_]:
        """Whether rays, both ``(N, 3)``, meet the mesh at all: ``(N,)``."""
        if not len(origins):
            return np.zeros(0, bool)
        return np.asarray(self.intersector.intersects_first(origins, directions)) >= 0

    def normals(self, face: NDArray[np.int64], weights: Array) -> Array:
        """Smooth unit normals ``(N, 3)`` at points of faces."""
        normals = np.einsum("nc,ncd->nd", weights, self.corner_normals[face])
        return normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-300)


def _corner_normals(vertices: Array, faces: NDArray[np.int64], area: Array, normals: Array) -> Array:
    """``(F, 3, 3)``: at each corner the average by area of the faces around it that are not beyond a crease."""
    # Vertices doubled at texture seams are one point of the surface.
    _, place = np.unique(vertices.round(9), axis=0, return_inverse=True)
    corner = place.reshape(-1)[faces].ravel()
    ones = np.ones(len(corner))
    around = csr_array((ones, (corner, np.repeat(np.arange(len(faces)), 3))))
    here = csr_array((ones, (np.arange(len(corner)), corner)))
    pairs = (here @ around).tocoo()  # a corner and each face around it
    smooth = np.einsum("pd,pd->p", normals[pairs.row // 3], normals[pairs.col]) > _CREASE
    sums = (
        csr_array((ones[:1].repeat(smooth.sum()), (pairs.row[smooth], pairs.col[smooth])), pairs.shape) @ area
    )
    sums /= np.linalg.norm(sums, axis=1, keepdims=True).clip(1e-300)
    return sums.reshape(-1, 3, 3)
