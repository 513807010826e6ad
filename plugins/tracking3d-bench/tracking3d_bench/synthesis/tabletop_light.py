"""Light of the table and the wall, with the shadows of what is above them.

Their colours come from pictures through homographies; the light that they receive is worked out on a coarse grid.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d_bench.synthesis.lighting import AMBIENT, DIFFUSE, Lamp
from tracking3d_bench.synthesis.scene import Scene
from tracking3d_bench.synthesis.solid_rendering import LIFT, PosedSolid
from tracking3d_bench.synthesis.tabletop import Plane, Tabletop

Array = NDArray[np.float64]

_COARSE = 240  # cells of the grid per image height
_SHADOW_RAYS = 9  # points of the lamp
_OUTERMOST = 5  # the last of them, which are at its rim


def surroundings_light(
    scene: Scene, tabletop: Tabletop, T_cam_rest: Array, solids: list[PosedSolid], lamp: Lamp
) -> NDArray[np.float32]:
    """Linear light ``(H, W, 3)`` of table and wall with the shadows of the ``solids`` on them."""
    width, height = scene.camera.width, scene.camera.height
    step = max(1, round(height / _COARSE))
    light = np.zeros((height, width, 3), np.float32)
    on_table = _table_share(scene, tabletop, T_cam_rest)
    for plane, share in ((tabletop.table, on_table), (tabletop.wall, 1 - on_table)):
        seen = np.flatnonzero(share.any(1))
        if not len(seen):
            continue
        top, bottom = int(seen[0]) // step * step, int(seen[-1]) + 1
        to_plane = np.linalg.inv(plane.to_pixels(scene.camera.K, T_cam_rest)).astype(np.float64)
        lower = np.array([[1.0, 0, 0], [0, 1, top], [0, 0, 1]])
        albedo = cv2.warpPerspective(
            plane.picture,
            plane.to_picture @ to_plane @ lower,
            (width, bottom - top),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
        columns, rows = np.meshgrid(np.arange(-(-width // step)), np.arange(top // step, -(-bottom // step)))
        # cv2.resize takes pixel centres of the grid to the middle of their cells.
        pixels = step * (np.stack([columns, rows]).astype(np.float64) + 0.5) - 0.5
        received = _light_on(scene, plane, T_cam_rest, to_plane, pixels, solids, lamp)
        full = cv2.resize(received, (step * columns.shape[1], step * columns.shape[0]))
        factor = full[: bottom - top, :width] * share[top:bottom]
        light[top:bottom] += albedo * factor[..., None]
    light *= lamp.brightness.astype(np.float32)
    return light


def _table_share(scene: Scene, tabletop: Tabletop, T_cam_rest: Array) -> NDArray[np.float32]:
    """Share of each pixel ``(H, W)`` that shows the table and not the wall."""
    H = tabletop.wall.to_pixels(scene.camera.K, T_cam_rest)
    line = np.cross(H @ (-1.0, 0.0, 1.0), H @ (1.0, 0.0, 1.0))  # where they meet
    line /= np.linalg.norm(line[:2])
    x = np.arange(scene.camera.width, dtype=np.float32)
    y = np.arange(scene.camera.height, dtype=np.float32)
    a, b, c = (line if line[1] > 0 else -line).astype(np.float32)
    share: NDArray[np.float32] = (a * x + b * y[:, None] + c + 0.5).clip(0, 1)
    return share


def _light_on(
    scene: Scene,
    plane: Plane,
    T_cam_rest: Array,
    to_plane: Array,
    pixels: Array,
    solids: list[PosedSolid],
    lamp: Lamp,
) -> NDArray[np.float32]:
    """Light ``(h, w)`` that a plane receives where ``pixels``, x and y ``(2, h, w)``, see it."""
    x, y, w = to_plane @ np.concatenate([pixels.reshape(2, -1), np.ones((1, pixels[0].size))])
    w = np.where(np.abs(w) > 1e-12, w, 1e-12)
    R, t = T_cam_rest[:3, :3], T_cam_rest[:3, 3]
    place = np.stack([x / w, y / w], 1)
    points = place @ (R @ plane.axes[:, :2]).T.copy() + (R @ plane.origin + t)
    normal = R @ plane.axes[:, 2]
    towards = lamp.position - points
    cosine = (towards @ normal / np.linalg.norm(towards, axis=1)).clip(0)
    lit = np.ones(len(points))
    sources = lamp.points(_SHADOW_RAYS)
    for solid in solids:
        near = (cosine > 0) & (points[:, 2] > 0) & _may_be_shadowed(plane, T_cam_rest, solid, place, sources)
        near = np.flatnonzero(near)
        lit[near] *= _unblocked(solid, points[near] + LIFT * scene.solid.radius * normal, sources)
    received = (AMBIENT + DIFFUSE * cosine * lit).astype(np.float32)
    return cv2.GaussianBlur(received.reshape(pixels[0].shape), (0, 0), 1.0)


def _may_be_shadowed(
    plane: Plane, T_cam_rest: Array, solid: PosedSolid, place: Array, sources: Array
) -> NDArray[np.bool_]:
    """Whether points of a plane ``(N,)`` are in the rectangle around the shadow of a solid."""
    to_plane = np.linalg.inv(T_cam_rest)

    to_axes = to_plane[:3, :3].T @ plane.axes
    shift = (to_plane[:3, 3] - plane.origin) @ plane.axes
    vertices = solid.vertices @ to_axes + shift
    inside = np.zeros(len(place), bool)
    lows, highs = [], []
    for source in sources[-_OUTERMOST:] @ to_axes + shift:
        below = source[2] - vertices[:, 2]
        ahead = below > 1e-3 * source[2]  # what is as high as the lamp throws its shadow far away
        if not ahead.any():
            continue
        cast = source[:2] + (vertices[ahead, :2] - source[:2]) * (source[2] / below[ahead])[:, None]
        lows.append(cast.min(0))
        highs.append(cast.max(0))
    if lows:
        inside = ((place >= np.min(lows, 0)) & (place <= np.max(highs, 0))).all(1)
    return inside


def _unblocked(solid: PosedSolid, points: Array, sources: Array) -> Array:
    """Share of the lamp's points ``sources`` ``(K, 3)`` that a solid does not hide from points ``(N, 3)``."""
    R, t = solid.T[:3, :3], solid.T[:3, 3]
    origins = (points - t) @ R
    blocked = [solid.surface.is_blocked(origins, (source - points) @ R) for source in sources]
    share: Array = 1 - np.mean(blocked, 0)
    return share
