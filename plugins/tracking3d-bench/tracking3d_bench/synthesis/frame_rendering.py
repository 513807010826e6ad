"""One frame of a scene by distributed ray casting, and its exact truth.

Each of the S x S rays of a pixel goes through another part of the pixel, at another time while the shutter is
open, and asks another part of the lamp for its light (Cook, Porter and Carpenter, Distributed ray tracing, 1984).
The middle one goes through the pixel's centre at the frame's time: it gives masks and depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d_bench.synthesis.camera_effects import expose
from tracking3d_bench.synthesis.lighting import Lamp, shade
from tracking3d_bench.synthesis.room_rendering import room_light
from tracking3d_bench.synthesis.scene import Scene
from tracking3d_bench.synthesis.solid_rendering import LIFT, albedo_at, in_shadow, lamp_of_frame, look_at
from tracking3d_bench.synthesis.tabletop_rendering import render_tabletop

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """An image and its truth."""

    image: NDArray[np.uint8]  # (H, W, 3) uint8 RGB, before JPEG compression
    mask: NDArray[np.bool_]  # (H, W) bool, the object as if nothing were in front of it
    visible_mask: NDArray[np.bool_]  # (H, W) bool, what is seen of it
    # (H, W) float32, z of the object at the centres of the pixels of `mask`; 0 elsewhere
    depth: NDArray[np.float32]


def render_frame(scene: Scene, frame: int) -> RenderedFrame:
    """Render the frame of an index; it does not depend on other frames having been rendered."""
    spec = scene.spec
    if scene.tabletop is not None:
        light, z, front = render_tabletop(scene, scene.tabletop, frame)
        image = expose(light, spec.disturbances, spec.random(f"noise {frame}"))
        mask = np.isfinite(z)
        return RenderedFrame(image, mask, mask & (z < front), np.where(mask, z, 0).astype(np.float32))
    count = spec.supersample**2
    middle = count // 2
    offsets, times = _samples(scene)
    lamp = lamp_of_frame(scene, frame)
    light = np.zeros((*scene.background.shape[:2], 3))
    for k, source in enumerate(lamp.points(count)):
        sample, depth, front = _sample(scene, frame + times[k], offsets[k], lamp, source)
        light += sample
        if k == middle:
            mask, visible, z = np.isfinite(depth), np.isfinite(depth) & (depth < front), depth
    image = expose((light / count).astype(np.float32), spec.disturbances, spec.random(f"noise {frame}"))
    return RenderedFrame(image, mask, visible, np.where(mask, z, 0).astype(np.float32))


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
    """Light ``(H, W, 3)`` of one ray a pixel, and the depths ``(H, W)`` of object and hand, infinite outside them."""
    T_cam_obj = scene.path.T_cam_obj(np.array([time]))[0]
    light = scene.background * lamp.brightness
    depth, front = np.full(light.shape[:2], np.inf), np.full(light.shape[:2], np.inf)
    hand, T_cam_hand = scene.hand, np.eye(4)
    hand_surface = hand.surface_at(time) if hand else None
    lift = LIFT * scene.solid.radius

    seen = look_at(scene, scene.surface, T_cam_obj, offset)
    lit = ~in_shadow(scene.surface, T_cam_obj, seen, source, lift)
    if hand is not None and hand_surface is not None:
        T_cam_hand = hand.T_cam_hand(time)
        lit &= ~in_shadow(hand_surface, T_cam_hand, seen, source, lift)
    light[seen.pixels] = shade(albedo_at(scene, seen.hits), seen.points, seen.normals, lit, lamp, source)
    depth[seen.pixels] = seen.depth
    if scene.room is not None:
        rows, columns = np.nonzero(np.isinf(depth))
        x, y = columns + offset[0], rows + offset[1]
        around, far = room_light(scene, scene.room, T_cam_obj, x, y, lamp, source)
        met = np.isfinite(far)
        light[rows[met], columns[met]] = around[met]
    if hand is not None and hand_surface is not None:
        over = look_at(scene, hand_surface, T_cam_hand, offset)
        nearer = over.depth < depth[over.pixels]
        in_hand = (over.points - T_cam_hand[:3, 3]) @ T_cam_hand[:3, :3]
        lit = np.ones(len(in_hand), bool)
        skin = shade(hand.albedo(in_hand), over.points, over.normals, lit, lamp, source)
        rows, columns = (index[nearer] for index in over.pixels)
        light[rows, columns] = skin[nearer]
        front[over.pixels] = over.depth
    return light, depth, front
