"""Frames of an object that a hand takes from a table, at the size of a phone's video.

Unlike with other motions not all pixels get several rays. The table is seen through homographies, and the light on it
is worked out on a coarse grid. Only pixels on outlines and edges of the object and the hand, and those that see the
object at a slant, are cast at more than once. Shadows are soft: they are asked for at a part of the pixels, with
several points of the lamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.synthesis.lighting import AMBIENT, DIFFUSE, Lamp, shade
from tracking3d.synthesis.pixel_rays import camera_to_pixels, pixels_around
from tracking3d.synthesis.ray_casting import RayMesh
from tracking3d.synthesis.scene import Scene
from tracking3d.synthesis.solid_rendering import (
    LIFT,
    Pixels,
    Sight,
    albedo_at,
    in_shadow,
    lamp_of_frame,
    look_at,
)
from tracking3d.synthesis.tabletop import Plane, Tabletop

Array = NDArray[np.float64]

_COARSE = 240  # cells of the grid of light per image height
_SEARCH = 160  # rays per image height with which the hand is searched
_SHADOW_RAYS, _SHADOW_RAYS_BELOW = 4, 9  # points of the lamp for object and hand, and for table and wall
_OUTERMOST = 5  # the last of them, which are at the rim of the lamp
_SPARSE = 3  # pixels from one to the next at which shadows on object and hand are asked for
_EDGE = 0.9  # cosine between neighbouring normals below which there is an edge
_SLANTED = 0.25  # cosine between normal and ray below which one ray a pixel would miss texels

_FAR_OUT = 20_000  # pixels; what is drawn farther out could overflow

_NOTHING, _OBJECT, _HAND = 0, 1, 2


@dataclass(frozen=True, eq=False)
class _Solid:
    """What stands in the light: a surface and its pose in camera axes."""

    surface: RayMesh
    T: Array

    @cached_property
    def vertices(self) -> Array:
        """``(V, 3)`` in camera axes."""
        vertices: Array = self.surface.vertices @ self.T[:3, :3].T.copy() + self.T[:3, 3]
        return vertices


def render_tabletop(scene: Scene, tabletop: Tabletop, frame: int) -> tuple[NDArray[np.float32], Array, Array]:
    """Light ``(H, W, 3)`` of a frame, and the depths ``(H, W)`` of object and hand, infinite outside them."""
    lamp = lamp_of_frame(scene, frame)
    solids = [_Solid(scene.surface, scene.path.T_cam_obj(np.array([float(frame)]))[0])]
    if scene.hand is not None and (surface := scene.hand.surface_at(float(frame))) is not None:
        solids.append(_Solid(surface, scene.hand.T_cam_hand(float(frame))))
    T_cam_rest = scene.path.T_cam_rest(np.array([float(frame)]))[0]
    light = _surroundings(scene, tabletop, T_cam_rest, solids, lamp)
    depths = np.full((2, *light.shape[:2]), np.inf)
    kind = np.full(light.shape[:2], _NOTHING, np.int8)
    normals = np.zeros((*light.shape[:2], 3), np.float32)
    slanted = np.zeros(light.shape[:2], bool)
    empty = light.copy()
    lit_parts = []
    for k, solid in enumerate(solids):
        pixels = _pixels_of_hand(scene, solid) if k else _pixels_of_object(scene, solid)
        seen = look_at(scene, solid.surface, solid.T, np.zeros(2), pixels)
        depths[k][seen.pixels] = seen.depth
        nearer = seen.depth <= depths[:, seen.pixels[0], seen.pixels[1]].min(0)
        lit = _lit_share(scene, solids, seen, lamp)
        colours = _shaded(scene, k, seen, lit, lamp, lamp.position)
        lit_parts.append(_filled(lit, seen.pixels, light.shape[:2]))
        where = seen.pixels[0][nearer], seen.pixels[1][nearer]
        light[where], kind[where], normals[where] = colours[nearer], k + 1, seen.normals[nearer]
        facing = -np.einsum("ij,ij->i", seen.normals, seen.points) / np.linalg.norm(seen.points, axis=1)
        slanted[where] = (facing < _SLANTED)[nearer] if k == 0 else False
    _smooth_edges(scene, solids, lit_parts, lamp, light, empty, _rough_pixels(kind, normals, slanted))
    return light, depths[0], depths[1]


def _surroundings(
    scene: Scene, tabletop: Tabletop, T_cam_rest: Array, solids: list[_Solid], lamp: Lamp
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
    solids: list[_Solid],
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
    sources = lamp.points(_SHADOW_RAYS_BELOW)
    for solid in solids:
        near = (cosine > 0) & (points[:, 2] > 0) & _may_be_shadowed(plane, T_cam_rest, solid, place, sources)
        near = np.flatnonzero(near)
        lit[near] *= _unblocked(solid, points[near] + LIFT * scene.solid.radius * normal, sources)
    received = (AMBIENT + DIFFUSE * cosine * lit).astype(np.float32)
    return cv2.GaussianBlur(received.reshape(pixels[0].shape), (0, 0), 1.0)


def _may_be_shadowed(
    plane: Plane, T_cam_rest: Array, solid: _Solid, place: Array, sources: Array
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


def _unblocked(solid: _Solid, points: Array, sources: Array) -> Array:
    """Share of the lamp's points ``sources`` ``(K, 3)`` that a solid does not hide from points ``(N, 3)``."""
    R, t = solid.T[:3, :3], solid.T[:3, 3]
    origins = (points - t) @ R
    blocked = [solid.surface.is_blocked(origins, (source - points) @ R) for source in sources]
    share: Array = 1 - np.mean(blocked, 0)
    return share


def _pixels_of_object(scene: Scene, solid: _Solid) -> Pixels | None:
    """Pixels of the convex outline of the object; None if it reaches behind the camera."""
    corners = camera_to_pixels(scene.camera, solid.vertices)
    if np.isnan(corners).any() or np.abs(corners).max() > _FAR_OUT:
        return None
    hull = cv2.convexHull(corners.astype(np.float32)).round().astype(np.int32)
    inside = np.zeros((scene.camera.height, scene.camera.width), np.uint8)
    cv2.fillConvexPoly(inside, hull, 1)
    found = np.nonzero(cv2.dilate(inside, np.ones((5, 5), np.uint8)))
    return found[0], found[1]


def _pixels_of_hand(scene: Scene, hand: _Solid) -> Pixels:
    """Pixels around all that a coarse grid of rays meets of a hand, whose arm may reach behind the camera."""
    width, height = scene.camera.width, scene.camera.height
    step = max(1, round(height / _SEARCH))
    columns, rows = pixels_around(hand.surface.vertices, hand.T, scene.camera, step)
    if not len(columns):
        return rows, columns
    columns = (columns // step) * step
    rows = (rows // step) * step
    met = look_at(scene, hand.surface, hand.T, np.zeros(2), (rows, columns)).pixels
    cells = np.zeros((-(-height // step), -(-width // step)), np.uint8)
    cells[met[0] // step, met[1] // step] = 1
    cells = cv2.dilate(cells, np.ones((3, 3), np.uint8))
    full = np.repeat(np.repeat(cells, step, 0), step, 1)[:height, :width]
    found = np.nonzero(full)
    return found[0], found[1]


def _lit_share(scene: Scene, solids: list[_Solid], seen: Sight, lamp: Lamp) -> Array:
    """How much of the lamp is seen from the points of a sight ``(N,)``; worked out at a part of the pixels."""
    rows, columns = seen.pixels
    if not len(rows):
        return np.ones(0)
    lift = LIFT * scene.solid.radius
    some = np.flatnonzero((rows % _SPARSE == 0) & (columns % _SPARSE == 0))
    if not len(some):
        some = np.arange(len(rows))
    part = seen.part(some)
    shadowed = np.zeros(len(some))
    sources = lamp.points(_SHADOW_RAYS)
    for source in sources:
        hidden = np.zeros(len(some), bool)
        for solid in solids:
            hidden |= in_shadow(solid.surface, solid.T, part, source, lift)
        shadowed += hidden / len(sources)
    top, left = rows.min() // _SPARSE, columns.min() // _SPARSE
    shape = (rows.max() // _SPARSE - top + 1, columns.max() // _SPARSE - left + 1)
    known, lit = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    here = rows[some] // _SPARSE - top, columns[some] // _SPARSE - left
    known[here], lit[here] = 1, 1 - shadowed
    known, lit = (cv2.GaussianBlur(grid, (0, 0), 0.7) for grid in (known, lit))
    x = (columns / _SPARSE - left).astype(np.float32)
    y = (rows / _SPARSE - top).astype(np.float32)
    known, lit = (_interpolated(grid, x, y) for grid in (known, lit))
    share: Array = np.where(known > 1e-3, lit / known.clip(1e-3), 1.0).clip(0, 1)
    return share


def _filled(lit: Array, pixels: Pixels, shape: tuple[int, int]) -> NDArray[np.float32]:
    """How much of the lamp is seen in all pixels ``(H, W)``: beyond an outline what is darkest beside it."""
    known = np.ones(shape, np.float32)
    known[pixels] = lit
    around: NDArray[np.float32] = cv2.erode(known, np.ones((3, 3), np.uint8))
    around[pixels] = lit
    return around


def _interpolated(grid: NDArray[np.float32], x: NDArray[np.float32], y: NDArray[np.float32]) -> Array:
    """Bilinear values ``(N,)`` of a grid ``(h, w)`` at columns ``x`` and rows ``y``, both ``(N,)``."""
    columns, rows = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, below = x - columns, y - rows
    following = np.minimum(columns + 1, grid.shape[1] - 1), np.minimum(rows + 1, grid.shape[0] - 1)
    upper = grid[rows, columns] * (1 - right) + grid[rows, following[0]] * right
    lower = grid[following[1], columns] * (1 - right) + grid[following[1], following[0]] * right
    values: Array = (upper * (1 - below) + lower * below).astype(np.float64)
    return values


def _shaded(scene: Scene, kind: int, seen: Sight, lit: Array, lamp: Lamp, source: Array) -> Array:
    """Light ``(N, 3)`` of the object, of ``kind`` 0, or the hand."""
    if kind == 0 or scene.hand is None:
        albedo = albedo_at(scene, seen.hits)
    else:
        albedo = scene.hand.albedo((seen.points - seen.T[:3, 3]) @ seen.T[:3, :3])
    return shade(albedo, seen.points, seen.normals, lit, lamp, source)


def _rough_pixels(kind: NDArray[np.int8], normals: NDArray[np.float32], slanted: NDArray[np.bool_]) -> Pixels:
    """Pixels that need more than one ray: on either side of an outline or a sharp edge, or seen at a slant."""
    rows, columns = np.nonzero(kind)
    edge = slanted.copy()
    if len(rows):
        around = tuple(slice(max(index.min() - 1, 0), index.max() + 2) for index in (rows, columns))
        kind, normals, part = kind[around], normals[around], edge[around]
        for axis in (0, 1):
            a = tuple(slice(None, -1) if k == axis else slice(None) for k in (0, 1))
            b = tuple(slice(1, None) if k == axis else slice(None) for k in (0, 1))
            apart = kind[a] != kind[b]
            bent = np.einsum("ijk,ijk->ij", normals[a], normals[b]) < _EDGE
            apart |= bent & (kind[a] > 0) & (kind[b] > 0)
            part[a] |= apart
            part[b] |= apart
    found = np.nonzero(edge)
    return found[0], found[1]


def _smooth_edges(
    scene: Scene,
    solids: list[_Solid],
    lit_parts: list[NDArray[np.float32]],
    lamp: Lamp,
    light: NDArray[np.float32],
    empty: NDArray[np.float32],
    pixels: Pixels,
) -> None:
    """Average several rays in some pixels of ``light``, where rays that meet nothing see ``empty``.

    How much of the lamp is seen there, ``lit_parts`` ``(H, W)`` of each solid, is not asked for again.
    """
    side = scene.spec.supersample
    if side == 1 or not len(pixels[0]):
        return
    steps = (np.arange(side) - side // 2) / side
    offsets = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2)
    total = light[pixels].astype(np.float64)
    index = np.full(light.shape[:2], -1, np.int64)
    index[pixels] = np.arange(len(pixels[0]))
    sources = lamp.points(side**2)
    chosen = range(0, side**2, 2)  # as the squares of one colour on a chessboard; the middle is one of them
    for k in chosen:
        if k == side**2 // 2:
            continue  # its ray is there already
        source = sources[k]
        sample = empty[pixels].astype(np.float64)
        nearest = np.full(len(sample), np.inf)
        for kind, solid in enumerate(solids):
            seen = look_at(scene, solid.surface, solid.T, offsets[k], pixels)
            lit = lit_parts[kind][seen.pixels].astype(np.float64)
            place = index[seen.pixels]
            nearer = seen.depth < nearest[place]
            colours = _shaded(scene, kind, seen, lit, lamp, source)
            sample[place[nearer]] = colours[nearer]
            nearest[place[nearer]] = seen.depth[nearer]
        total += sample
    light[pixels] = total / len(chosen)
