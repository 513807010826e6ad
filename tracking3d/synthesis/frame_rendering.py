"""One frame of a scene by distributed ray casting, and its exact truth.

Each of the S x S rays of a pixel goes through another part of the pixel, at another time while the shutter is
open, and asks another part of the lamp for its light (Cook, Porter and Carpenter, Distributed ray tracing, 1984).
The middle one goes through the pixel's centre at the frame's time: it gives masks and depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.synthesis.camera_effects import exposed, linear
from tracking3d.synthesis.lighting import Lamp, lamp_at, shaded
from tracking3d.synthesis.pixel_rays import pixels_around, ray_directions
from tracking3d.synthesis.ray_casting import MeshHits, RayMesh
from tracking3d.synthesis.room_rendering import room_light
from tracking3d.synthesis.scene import Scene
from tracking3d.synthesis.texture_lookup import bilinear

Array = NDArray[np.float64]

_LIFT = 1e-4  # of shadow rays off the surface, in object radii


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """An image and its truth.

    Attributes:
        image: ``(H, W, 3)`` uint8 RGB, before JPEG compression.
        mask: ``(H, W)`` bool, the object as if nothing were in front of it.
        visible_mask: ``(H, W)`` bool, what is seen of it.
        depth: ``(H, W)`` float32, z of the object at the centres of the pixels of `mask`; 0 elsewhere.
    """

    image: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    visible_mask: NDArray[np.bool_]
    depth: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class _Sight:
    """What the rays of one sample through all pixels around a solid meet."""

    pixels: tuple[NDArray[np.int64], NDArray[np.int64]]
    depth: Array
    points: Array
    normals: Array
    hits: MeshHits
    T: Array


def render_frame(scene: Scene, frame: int) -> RenderedFrame:
    """Render the frame of an index; it does not depend on other frames having been rendered."""
    spec = scene.spec
    count = spec.supersample**2
    middle = count // 2
    offsets, times = _samples(scene)
    lamp = _lamp(scene, frame)
    light = np.zeros((*scene.background.shape[:2], 3))
    for k, source in enumerate(lamp.points(count)):
        sample, depth, front = _sample(scene, frame + times[k], offsets[k], lamp, source)
        light += sample
        if k == middle:
            mask, visible, z = np.isfinite(depth), np.isfinite(depth) & (depth < front), depth
    image = exposed((light / count).astype(np.float32), spec.disturbances, spec.random(f"noise {frame}"))
    return RenderedFrame(image, mask, visible, np.where(mask, z, 0).astype(np.float32))


def _lamp(scene: Scene, frame: int) -> Lamp:
    """The lamp of a frame in camera axes: it stays with the camera, or in the room where there is one."""
    T_start, T_now = scene.path.T_cam_obj(np.array([0.0, frame]))
    lamp = lamp_at(scene.spec, frame, T_start[:3, 3], scene.solid.radius)
    if scene.room is None:
        return lamp
    T = T_now @ np.linalg.inv(T_start)
    return replace(lamp, position=T[:3, :3] @ lamp.position + T[:3, 3])


def _samples(scene: Scene) -> tuple[Array, Array]:
    """Offsets ``(S * S, 2)`` in the pixel and times ``(S * S,)`` relative to the frame's; the middle ones are 0."""
    side = scene.spec.supersample
    count = side**2
    steps = (np.arange(side) - side // 2) / side
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    order = np.delete(np.arange(count), count // 2)
    scene.spec.random("samples").shuffle(order)
    offsets = offsets[np.insert(order, count // 2, count // 2)]
    shutter = scene.spec.disturbances.motion_blur
    return offsets, shutter * (np.arange(count) - count // 2) / count


def _sample(
    scene: Scene, time: float, offset: Array, lamp: Lamp, source: Array
) -> tuple[Array, Array, Array]:
    """Light ``(H, W, 3)`` of one ray a pixel, and the depths ``(H, W)`` of object and hand, infinite beside them."""
    T_cam_obj = scene.path.T_cam_obj(np.array([time]))[0]
    light = scene.background * lamp.brightness
    depth, front = np.full(light.shape[:2], np.inf), np.full(light.shape[:2], np.inf)
    hand, T_cam_hand = scene.hand, np.eye(4)
    lift = _LIFT * scene.solid.radius

    seen = _look(scene, scene.surface, T_cam_obj, offset)
    lit = ~_shadowed(scene.surface, T_cam_obj, seen, source, lift)
    if hand is not None:
        T_cam_hand = hand.T_cam_hand(time)
        lit &= ~_shadowed(hand.surface, T_cam_hand, seen, source, lift)
    light[seen.pixels] = shaded(_albedo(scene, seen.hits), seen.points, seen.normals, lit, lamp, source)
    depth[seen.pixels] = seen.depth
    if scene.room is not None:
        rows, columns = np.nonzero(np.isinf(depth))
        x, y = columns + offset[0], rows + offset[1]
        around, far = room_light(scene, scene.room, T_cam_obj, x, y, lamp, source)
        met = np.isfinite(far)
        light[rows[met], columns[met]] = around[met]
    if hand is not None:
        over = _look(scene, hand.surface, T_cam_hand, offset)
        nearer = over.depth < depth[over.pixels]
        in_hand = (over.points - T_cam_hand[:3, 3]) @ T_cam_hand[:3, :3]
        lit = np.ones(len(in_hand), bool)
        skin = shaded(hand.albedo(in_hand), over.points, over.normals, lit, lamp, source)
        rows, columns = (index[nearer] for index in over.pixels)
        light[rows, columns] = skin[nearer]
        front[over.pixels] = over.depth
    return light, depth, front


def _look(scene: Scene, surface: RayMesh, T: Array, offset: Array) -> _Sight:
    """Cast one ray a pixel at a solid of pose ``T`` ``(4, 4)``."""
    columns, rows = pixels_around(surface.vertices, T, scene.camera)
    directions = ray_directions(scene.camera, columns + offset[0], rows + offset[1])
    R, t = T[:3, :3], T[:3, 3]
    hits = surface.cast(np.tile(-R.T @ t, (len(directions), 1)), directions @ R)
    hit = (hits.face >= 0) & (hits.distance > 0)
    hits = MeshHits(hits.face[hit], hits.distance[hit], hits.weights[hit])
    points = hits.distance[:, None] * directions[hit]
    normals = surface.normals(hits.face, hits.weights) @ R.T
    # Surfaces without inside and outside show their colour on both sides.
    away = np.einsum("ij,ij->i", surface.face_normals[hits.face] @ R.T, points) > 0
    normals[away] *= -1
    return _Sight((rows[hit], columns[hit]), hits.distance, points, normals, hits, T)


def _shadowed(surface: RayMesh, T: Array, seen: _Sight, source: Array, lift: float) -> NDArray[np.bool_]:
    """Whether a solid of pose ``T`` is between the points and a point of the lamp."""
    origins = seen.points + lift * seen.normals
    towards = source - origins
    facing = np.flatnonzero(np.einsum("ij,ij->i", seen.normals, towards) > 0)
    R, t = T[:3, :3], T[:3, 3]
    shadowed = np.zeros(len(origins), bool)
    shadowed[facing] = surface.blocked((origins[facing] - t) @ R, towards[facing] @ R)
    return shadowed


def _albedo(scene: Scene, hits: MeshHits) -> Array:
    """Linear colours ``(N, 3)`` of points of the object."""
    corners = scene.surface.faces[hits.face]
    if scene.texture is None or scene.solid.uvs is None:
        colours = np.asarray(scene.solid.colours, np.float64)[corners]
        return linear(np.einsum("nc,ncd->nd", hits.weights, colours)).astype(np.float64)
    uv = np.einsum("nc,ncd->nd", hits.weights, scene.solid.uvs[corners])
    return bilinear(scene.texture, uv)
