"""Exact ray casting of convex shapes, for clips with known truth.

Everything is analytic and in float64, and nothing of `tracking3d.rendering` is used: these images are what
the renderer is tested with. Points and directions are in object coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ConvexHits:
    """Where N rays meet a surface."""

    hit: NDArray[np.bool_]  # (N,) bool. The rows of the other arrays are meaningless where it is False.
    distance: Array  # (N,) along the ray, in lengths of its direction
    points: Array  # (N, 3) on the surface
    normals: Array  # (N, 3) unit, outward
    panel: NDArray[np.int64]  # (N,) int64, which texture panel covers the point
    uv: Array  # (N, 2) position in the panel; [0, 1] spans it


class ConvexSurface(Protocol):
    """A closed convex surface around the origin, covered by texture panels."""

    @property
    def panels(self) -> int:
        """Number of texture panels."""
        ...

    @property
    def radius(self) -> float:
        """Radius of a sphere around the origin which encloses the surface."""
        ...

    def cast(self, origin: Array, directions: Array) -> ConvexHits:
        """First hits of rays from ``origin`` ``(3,)``, which is outside, along ``directions`` ``(N, 3)``."""
        ...


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """A convex polyhedron as the intersection of half-spaces ``normal . x <= offset``; one panel per plane."""

    normals: Array  # (P, 3) unit, outward
    offsets: Array  # (P,) positive
    radius: float  # radius of an enclosing sphere around the origin

    @classmethod
    def box(cls, half_sizes: tuple[float, float, float], chamfer: float = 0.0) -> Polyhedron:
        """A box; with ``chamfer`` in (0, 1] its eight corners are cut off that far towards the centre."""
        half = np.asarray(half_sizes, dtype=np.float64)
        normals = np.concatenate([np.eye(3), -np.eye(3)])
        offsets = np.concatenate([half, half])
        if chamfer > 0:
            corners = (
                np.stack(np.meshgrid([1, -1], [1, -1], [1, -1], indexing="ij"), -1).reshape(-1, 3) * half
            )
            length = np.linalg.norm(corners, axis=1)
            normals = np.concatenate([normals, corners / length[:, None]])
            offsets = np.concatenate([offsets, (1 - chamfer) * length])
        return cls(normals, offsets, float(np.linalg.norm(half)))

    @property
    def panels(self) -> int:
        """Number of texture panels: one per plane."""
        return len(self.offsets)

    def cast(self, origin: Array, directions: Array) -> ConvexHits:
        """See `ConvexSurface.cast`: a ray enters by the last plane facing ``origin``, if not out by another yet."""
        slope = self.normals @ directions.T
        room = self.offsets - self.normals @ origin
        facing = np.flatnonzero(room < 0)
        behind = np.flatnonzero(room >= 0)
        with np.errstate(divide="ignore"):
            entry = np.where(slope[facing] < 0, room[facing, None] / slope[facing], np.inf)
            leave = np.where(slope[behind] > 0, room[behind, None] / slope[behind], np.inf)
        last = entry.argmax(axis=0)
        panel = facing[last]
        distance = entry[last, np.arange(len(directions))]
        hit = distance < leave.min(axis=0)
        points = origin + np.where(hit, distance, 0.0)[:, None] * directions
        uv = np.einsum("nij,nj->ni", _tangents(self.normals)[panel], points) / (2 * self.radius) + 0.5
        return ConvexHits(hit, distance, points, self.normals[panel], panel, uv)


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An axis-aligned ellipsoid around the origin with the six panels of a cube map."""

    radii: Array  # (3,) half axes

    panels: int = 6

    @property
    def radius(self) -> float:
        """The longest half axis."""
        return float(np.max(self.radii))

    def cast(self, origin: Array, directions: Array) -> ConvexHits:
        """See `ConvexSurface.cast`: the smaller root of a quadratic, where this is the unit sphere."""
        o, d = origin / self.radii, directions / self.radii
        a, b, c = (d * d).sum(axis=1), d @ o, o @ o - 1
        discriminant = b * b - a * c
        distance = (-b - np.sqrt(np.maximum(discriminant, 0))) / a
        hit = (discriminant > 0) & (distance > 0)
        unit = o + distance[:, None] * d
        normals = unit / self.radii
        axis = np.abs(unit).argmax(axis=1)
        main = np.take_along_axis(unit, axis[:, None], axis=1)
        others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        uv = np.take_along_axis(unit, others, axis=1) / (2 * main) + 0.5
        return ConvexHits(
            hit,
            distance,
            unit * self.radii,
            normals / np.linalg.norm(normals, axis=1, keepdims=True),
            axis + 3 * (main[:, 0] < 0),
            uv,
        )


def _tangents(normals: Array) -> Array:
    """``(P, 2, 3)`` two unit tangents per normal ``(P, 3)``."""
    helper = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first)], axis=1)
