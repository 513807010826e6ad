"""The room around a still object that a camera walks round: walls, floor, ceiling, a table and some clutter.

The room and all in it are rigid with the object. Walls are seen from inside only: through a long lens the camera
stands outside and sees the room as if the wall before it were not there. Nothing in it ever hides the object:
the camera is above the table, what is higher than the table stands where the camera does not go.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.testing.synthesis.procedural_texture import paint_background, paint_panel
from tracking3d_bench.synthesis.camera_effects import linear
from tracking3d_bench.synthesis.motions import Path
from tracking3d_bench.synthesis.patches import Array, Patch, prism, rectangle
from tracking3d_bench.synthesis.random_solids import assembly, organic
from tracking3d_bench.synthesis.ray_casting import RayMesh
from tracking3d_bench.synthesis.solid import Solid
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.texture_lookup import pyramid

_HOVER = 0.01  # of the object over the table
_ASIDE = math.radians(60)  # between the camera and what is higher than the table, as seen from the object
_WALL_TEXELS, _TABLE_TEXELS, _CLUTTER_TEXELS = 1024, 512, 128


@dataclass(frozen=True, eq=False)
class Room:
    """A box with things in it, in coordinates whose origin is the object's, y up and axes along the walls.

    Attributes:
        T_obj_room: ``(4, 4)`` pose of the room in the object's coordinates.
        low, high: ``(3,)`` corners of the box.
        furniture: The table and the clutter for rays.
        uvs: ``(V, 2)`` texture coordinates of their vertices.
        looks: ``(F,)`` index in `textures` of their faces.
        density: ``(F,)`` texels of the finest level per length on their faces.
        textures: Pyramids in linear light; the first six are the walls', in the order low x, high x, floor, ceiling,
            low z, high z.
    """

    T_obj_room: Array
    low: Array
    high: Array
    furniture: RayMesh
    uvs: Array
    looks: NDArray[np.int64]
    density: Array
    textures: list[list[NDArray[np.float32]]]


def build_room(spec: SequenceSpec, solid: Solid, path: Path) -> Room | None:
    """The room of a sequence in which the camera walks round the object; None for other motions."""
    if spec.motion != "walk_round":
        return None
    rng = spec.random("room")
    R_obj_room = Rotation.from_euler("y", rng.uniform(0, 360), degrees=True).as_matrix()
    table = solid.vertices[:, 1].min() / solid.radius - _HOVER
    floor = table - rng.uniform(1.4, 2.4)
    half = rng.uniform(7.2, 8.5, 2)
    things = [_block((0, 0), rng.uniform(1.9, 2.6, 2), (floor, table))]
    things += _clutter(rng, table, floor, half, *_behind(spec, path, R_obj_room))

    textures = [paint_plane(rng, _WALL_TEXELS) for _ in range(6)]
    textures.append(paint_plane(rng, _TABLE_TEXELS))
    textures += [pyramid(linear(paint_panel(rng, _CLUTTER_TEXELS))) for _ in things[1:]]
    vertices, faces, uvs, looks = [], [], [], []
    count = 0
    for look, patch in ((6 + k, patch) for k, thing in enumerate(things) for patch in thing):
        vertices.append(solid.radius * patch.vertices)
        faces.append(patch.faces + count)
        uvs.append(patch.uvs)
        looks.append(np.full(len(patch.faces), look))
        count += len(patch.vertices)
    mesh = trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)
    look_of_face, uv = np.concatenate(looks), np.concatenate(uvs)
    T_obj_room = np.eye(4)
    T_obj_room[:3, :3] = R_obj_room
    return Room(
        T_obj_room,
        solid.radius * np.array([-half[0], floor, -half[1]]),
        solid.radius * np.array([half[0], table + rng.uniform(8.2, 9.5), half[1]]),
        RayMesh.of(mesh),
        uv,
        look_of_face,
        _density(mesh, uv, np.array([levels[0].shape[0] for levels in textures])[look_of_face]),
        textures,
    )


def _behind(spec: SequenceSpec, path: Path, R_obj_room: Array) -> tuple[float, float]:
    """The direction that is behind the object, and how far to both sides of it no camera comes near, in radians.

    Directions are angles about y from z to x; the second is negative where the camera goes nearly all round.
    """
    T = path.T_cam_obj(np.arange(spec.frames, dtype=np.float64))
    cameras = -np.einsum("nij,ni->nj", T[:, :3, :3], T[:, :3, 3]) @ R_obj_room
    angles = np.unwrap(np.arctan2(cameras[:, 0], cameras[:, 2]))
    middle = 0.5 * (angles.min() + angles.max())
    return middle + math.pi, math.pi - 0.5 * np.ptp(angles) - _ASIDE


def _clutter(
    rng: np.random.Generator, table: float, floor: float, half: Array, behind: float, width: float
) -> list[list[Patch]]:
    """Things on the floor that are lower than the table, and higher ones and such on the table behind the object."""
    things = []
    for k in range(7):
        angle = behind + (k + rng.uniform(0.1, 0.9)) * 2 * math.pi / 7
        size = rng.uniform(0.25, 0.5) * (table - floor)
        things.append(_thing(rng, angle, rng.uniform(4.2, half.min() - 1.2), size, floor))
    if width > 0:
        for side in (-1, 1):
            angle = behind + side * rng.uniform(0.15, 0.95) * width
            things.append(_thing(rng, angle, 1.65, rng.uniform(0.15, 0.26), table))
            angle = behind + side * rng.uniform(0.3, 0.95) * width
            place = rng.uniform(4.2, half.min() - 1) * np.array([math.sin(angle), math.cos(angle)])
            things.append(_block(place, rng.uniform(0.3, 0.6, 2), (floor, table + rng.uniform(0.5, 2.5))))
    return things


def _thing(rng: np.random.Generator, angle: float, away: float, size: float, ground: float) -> list[Patch]:
    """A small thing that stands on the ``ground``."""
    patches = (organic if rng.random() < 0.5 else assembly)(rng)
    turn = Rotation.from_euler("y", rng.uniform(0, 360), degrees=True).as_matrix()
    lowest = min(patch.vertices[:, 1].min() for patch in patches)
    place = (away * math.sin(angle), ground - size * lowest, away * math.cos(angle))
    return [Patch(size * patch.vertices @ turn.T + place, patch.faces, patch.uvs) for patch in patches]


def _block(place: tuple[float, float] | Array, half: Array, heights: tuple[float, float]) -> list[Patch]:
    """An upright box at x and z of ``place``."""
    middle = np.array([place[0], 0.5 * sum(heights), place[1]])
    sides = prism(rectangle(half[0], 0.5 * (heights[1] - heights[0])), half[1])
    return [Patch(patch.vertices + middle, patch.faces, patch.uvs) for patch in sides]


def paint_plane(
    rng: np.random.Generator, texels: int, clutter: tuple[float, float] = (0.4, 2.0)
) -> list[NDArray[np.float32]]:
    """What is painted on a wall or the table, with the grain of plaster or wood rather than of a sensor."""
    painted = paint_background(rng, texels, texels, rng.uniform(*clutter))
    return pyramid(linear(cv2.GaussianBlur(painted, (0, 0), texels / 700)))


def _density(mesh: trimesh.Trimesh, uvs: Array, texels: NDArray[np.int64]) -> Array:
    """Texels per length ``(F,)`` on faces whose textures have ``texels`` ``(F,)`` a side."""
    a, b, c = uvs[mesh.faces].transpose(1, 0, 2)
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    density: Array = texels * np.sqrt(area / np.asarray(mesh.area_faces).clip(1e-12))
    return density
