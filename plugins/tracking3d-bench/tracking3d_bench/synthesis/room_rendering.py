"""Rendering of the room for rays that miss the object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d_bench.synthesis.lighting import Lamp, shade
from tracking3d_bench.synthesis.pixel_rays import ray_directions
from tracking3d_bench.synthesis.room import Room
from tracking3d_bench.synthesis.scene import Scene
from tracking3d_bench.synthesis.texture_lookup import filter_texture

Array = NDArray[np.float64]

_LIFT = 1e-3  # of shadow rays off the surface, in object radii


def room_light(
    scene: Scene, room: Room, T_cam_obj: Array, x: Array, y: Array, lamp: Lamp, source: Array
) -> tuple[Array, Array]:
    """Light and depth of the room.

    Args:
        scene: The sequence.
        room: Its room.
        T_cam_obj: ``(4, 4)``.
        x, y: ``(N,)`` pixels of the rays.
        lamp: In camera axes, as all light is.
        source: ``(3,)`` point of the lamp that shines.

    Returns:
        Light ``(N, 3)``, and depth ``(N,)``: infinite where a ray passes the room by; the light is 0 there.
    """
    T = T_cam_obj @ room.T_obj_room
    R, t = T[:3, :3], T[:3, 3]
    directions = ray_directions(scene.camera, x, y)
    along, origin = directions @ R, -R.T @ t
    enter, leave, axis = _through_box(origin, along, room.low, room.high)
    inside = leave > enter
    depth = np.where(inside, leave, np.inf)
    hits = room.furniture.cast(origin + enter[:, None] * along, along)
    met = (hits.face >= 0) & (enter + hits.distance < leave)
    depth[met] = enter[met] + hits.distance[met]

    rays = np.arange(len(x))
    normals = np.zeros_like(along)
    normals[rays, axis] = -np.sign(along[rays, axis])
    normals[met] = room.furniture.normals(hits.face[met], hits.weights[met])
    normals[np.einsum("ij,ij->i", normals, along) > 0] *= -1
    points = origin + np.where(inside, depth, 0)[:, None] * along

    look = 2 * axis + (along[rays, axis] > 0)
    uv, density = _on_walls(points, axis, room)
    corners = room.furniture.faces[hits.face[met]]
    uv[met] = np.einsum("nc,ncd->nd", hits.weights[met], room.uvs[corners])
    look[met], density[met] = room.looks[hits.face[met]], room.density[hits.face[met]]
    slant = np.abs(np.einsum("ij,ij->i", normals, along)) / np.linalg.norm(along, axis=1)
    apart = _apart(scene, depth) / np.sqrt(slant.clip(0.05))
    albedo = np.zeros((len(x), 3))
    for k in np.unique(look[inside]):
        here = inside & (look == k)
        albedo[here] = filter_texture(room.textures[k], uv[here], density[here] * apart[here])

    lit = ~_in_shadow(scene, room, points + _LIFT * scene.solid.radius * normals, (source - t) @ R)
    light = shade(albedo, points @ R.T + t, normals @ R.T, lit, lamp, source)
    return np.where(inside[:, None], light, 0), depth


def _apart(scene: Scene, depth: Array) -> Array:
    """Distance ``(N,)`` between neighbouring rays at ``depth`` ``(N,)``."""
    apart: Array = np.where(np.isfinite(depth), depth, 0) / (scene.spec.supersample * scene.camera.fy)
    return apart


def _through_box(
    origin: Array, along: Array, low: Array, high: Array
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Where rays enter a box, 0 if they start in it, where they leave it, and through the wall of which axis."""
    with np.errstate(divide="ignore", invalid="ignore"):
        through = (np.stack([low, high]) - origin)[:, None] / along
    near, far = through.min(0), through.max(0)
    axis = far.argmin(1)
    return near.max(1).clip(0), far[np.arange(len(far)), axis], axis


def _on_walls(points: Array, axis: NDArray[np.int64], room: Room) -> tuple[Array, Array]:
    """Texture coordinates ``(N, 2)`` on walls across ``axis`` ``(N,)``, and texels per length ``(N,)``."""
    extent = room.high - room.low
    share = (points - room.low) / extent
    across = np.array([2, 0, 0])[axis]
    up = np.array([1, 2, 1])[axis]
    rays = np.arange(len(points))
    texels = room.textures[0][0].shape[0]
    density = texels / np.sqrt(extent[across] * extent[up])
    return np.stack([share[rays, across], share[rays, up]], 1), density


def _in_shadow(scene: Scene, room: Room, points: Array, source: Array) -> NDArray[np.bool_]:
    """Whether the object or a thing in the room is between points and ``source``, all in the room's coordinates."""
    towards = source - points
    shadowed = room.furniture.is_blocked(points, towards)
    # Only what passes the object's enclosing sphere can meet it.
    nearest = -np.einsum("ij,ij->i", points, towards) / np.einsum("ij,ij->i", towards, towards)
    passing = points + nearest.clip(0)[:, None] * towards
    near = np.flatnonzero(~shadowed & (np.einsum("ij,ij->i", passing, passing) < scene.solid.radius**2))
    R = room.T_obj_room[:3, :3]
    shadowed[near] = scene.surface.is_blocked(points[near] @ R.T, towards[near] @ R.T)
    return shadowed
