"""What rays meet of the object and the hand, how it is lit there, and the lamp of a frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tracking3d_bench.synthesis.camera_effects import linear
from tracking3d_bench.synthesis.lighting import Lamp, lamp_at
from tracking3d_bench.synthesis.pixel_rays import pixels_around, ray_directions
from tracking3d_bench.synthesis.ray_casting import MeshHits, RayMesh
from tracking3d_bench.synthesis.scene import Scene
from tracking3d_bench.synthesis.texture_lookup import bilinear

Array = NDArray[np.float64]
Pixels = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Rows and columns, both ``(N,)``."""

LIFT = 1e-4
"""Of shadow rays off the surface, in object radii."""


@dataclass(frozen=True, eq=False)
class PosedSolid:
    """What stands in the light: a surface and its pose in camera axes."""

    surface: RayMesh
    T: Array

    @cached_property
    def vertices(self) -> Array:
        """``(V, 3)`` in camera axes."""
        vertices: Array = self.surface.vertices @ self.T[:3, :3].T.copy() + self.T[:3, 3]
        return vertices


@dataclass(frozen=True, eq=False)
class Sight:
    """What the rays of one sample through all pixels around a solid meet."""

    pixels: Pixels
    depth: Array
    points: Array
    normals: Array
    hits: MeshHits
    T: Array

    def part(self, chosen: NDArray[np.int64]) -> Sight:
        """What some of the rays meet."""
        hits = MeshHits(self.hits.face[chosen], self.hits.distance[chosen], self.hits.weights[chosen])
        pixels = self.pixels[0][chosen], self.pixels[1][chosen]
        return Sight(pixels, self.depth[chosen], self.points[chosen], self.normals[chosen], hits, self.T)


def lamp_of_frame(scene: Scene, frame: int) -> Lamp:
    """The lamp of a frame in camera axes: it stays with the camera, or with the room or table if there is one."""
    T_start, T_now = scene.path.T_cam_rest(np.array([0.0, frame]))
    lamp = lamp_at(scene.spec, frame, T_start[:3, 3], scene.solid.radius)
    if scene.room is None and scene.tabletop is None:
        return lamp
    T = T_now @ np.linalg.inv(T_start)
    return replace(lamp, position=T[:3, :3] @ lamp.position + T[:3, 3])


def look_at(scene: Scene, surface: RayMesh, T: Array, offset: Array, pixels: Pixels | None = None) -> Sight:
    """Cast one ray a pixel at a solid of pose ``T`` ``(4, 4)``.

    Args:
        scene: The sequence.
        surface: The solid.
        T: Its pose.
        offset: ``(2,)`` of the rays from the centres of the pixels.
        pixels: Which; all around the solid if left out.
    """
    if pixels is None:
        columns, rows = pixels_around(surface.vertices, T, scene.camera)
    else:
        rows, columns = pixels
    directions = ray_directions(scene.camera, columns + offset[0], rows + offset[1])
    R, t = T[:3, :3], T[:3, 3]
    to_camera = R.T.copy()  # products of many rows with a transposed view are a hundred times slower
    hits = surface.cast(np.tile(-R.T @ t, (len(directions), 1)), directions @ R)
    hit = (hits.face >= 0) & (hits.distance > 0)
    hits = MeshHits(hits.face[hit], hits.distance[hit], hits.weights[hit])
    points = hits.distance[:, None] * directions[hit]
    normals = surface.normals(hits.face, hits.weights) @ to_camera
    # Surfaces without inside and outside show their colour on both sides.
    away = np.einsum("ij,ij->i", surface.face_normals[hits.face] @ to_camera, points) > 0
    normals[away] *= -1
    return Sight((rows[hit], columns[hit]), hits.distance, points, normals, hits, T)


def in_shadow(surface: RayMesh, T: Array, seen: Sight, source: Array, lift: float) -> NDArray[np.bool_]:
    """Whether a solid of pose ``T`` is between the points and a point of the lamp."""
    origins = seen.points + lift * seen.normals
    towards = source - origins
    facing = np.flatnonzero(np.einsum("ij,ij->i", seen.normals, towards) > 0)
    R, t = T[:3, :3], T[:3, 3]
    shadowed = np.zeros(len(origins), bool)
    shadowed[facing] = surface.is_blocked((origins[facing] - t) @ R, towards[facing] @ R)
    return shadowed


def albedo_at(scene: Scene, hits: MeshHits) -> Array:
    """Linear colours ``(N, 3)`` of points of the object."""
    corners = scene.surface.faces[hits.face]
    if scene.texture is None or scene.solid.uvs is None:
        colours = np.asarray(scene.solid.colours, np.float64)[corners]
        return linear(np.einsum("nc,ncd->nd", hits.weights, colours)).astype(np.float64)
    uv = np.einsum("nc,ncd->nd", hits.weights, scene.solid.uvs[corners])
    return bilinear(scene.texture, uv)
