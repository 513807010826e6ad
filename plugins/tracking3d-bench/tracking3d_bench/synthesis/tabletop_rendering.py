"""Frames of an object that a hand takes from a table, at the size of a phone's video.

Unlike with other motions not all pixels get several rays. Only pixels on outlines and edges of the object and the hand,
and those that see the object at a slant, are cast at more than once. Shadows are soft: they are asked for at a part of
the pixels, with several points of the lamp.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d_bench.synthesis.lighting import Lamp, shade
from tracking3d_bench.synthesis.pixel_rays import camera_to_pixels, pixels_around
from tracking3d_bench.synthesis.scene import Scene
from tracking3d_bench.synthesis.solid_rendering import (
    LIFT,
    Pixels,
    PosedSolid,
    Sight,
    albedo_at,
    in_shadow,
    lamp_of_frame,
    look_at,
)
from tracking3d_bench.synthesis.tabletop import Tabletop
from tracking3d_bench.synthesis.tabletop_light import surroundings_light

Array = NDArray[np.float64]

_SEARCH = 160  # rays per image height with which the hand is searched
_SHADOW_RAYS = 4  # points of the lamp
_SPARSE = 3  # pixels from one to the next at which shadows on object and hand are asked for
_EDGE = 0.9  # cosine between neighbouring normals below which there is an edge
_SLANTED = 0.25  # cosine between normal and ray below which one ray a pixel would miss texels

_FAR_OUT = 20_000  # pixels; what is drawn farther out could overflow

_NOTHING = 0  # what a pixel sees; k + 1 is the solid of index k


def render_tabletop(scene: Scene, tabletop: Tabletop, frame: int) -> tuple[NDArray[np.float32], Array, Array]:
    """Light ``(H, W, 3)`` of a frame, and the depths ``(H, W)`` of object and hand, infinite outside them."""
    lamp = lamp_of_frame(scene, frame)
    solids = [PosedSolid(scene.surface, scene.path.T_cam_obj(np.array([float(frame)]))[0])]
    if scene.hand is not None and (surface := scene.hand.surface_at(float(frame))) is not None:
        solids.append(PosedSolid(surface, scene.hand.T_cam_hand(float(frame))))
    T_cam_rest = scene.path.T_cam_rest(np.array([float(frame)]))[0]
    light = surroundings_light(scene, tabletop, T_cam_rest, solids, lamp)
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


def _pixels_of_object(scene: Scene, solid: PosedSolid) -> Pixels | None:
    """Pixels of the convex outline of the object; None if it reaches behind the camera."""
    corners = camera_to_pixels(scene.camera, solid.vertices)
    if np.isnan(corners).any() or np.abs(corners).max() > _FAR_OUT:
        return None
    hull = cv2.convexHull(corners.astype(np.float32)).round().astype(np.int32)
    inside = np.zeros((scene.camera.height, scene.camera.width), np.uint8)
    cv2.fillConvexPoly(inside, hull, 1)
    found = np.nonzero(cv2.dilate(inside, np.ones((5, 5), np.uint8)))
    return found[0], found[1]


def _pixels_of_hand(scene: Scene, hand: PosedSolid) -> Pixels:
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


def _lit_share(scene: Scene, solids: list[PosedSolid], seen: Sight, lamp: Lamp) -> Array:
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
    solids: list[PosedSolid],
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
