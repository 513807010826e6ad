"""The solid of a hand that bends: rounded limbs between joints, and a palm, as overlapping closed meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from tracking3d_bench.synthesis.ray_casting import RayMesh

Array = NDArray[np.float64]

_AROUND, _RINGS = 20, 5  # facets around a limb, and rings of each of its round ends


@dataclass(frozen=True, eq=False)
class Limb:
    """A cylinder with round ends around two joints."""

    start: Array  # (3,) joint
    end: Array  # (3,) joint
    radius: float  # radius of the cylinder and its ends


def hand_surface(limbs: Sequence[Limb], palm_centre: Array, palm_radii: Array) -> RayMesh:
    """Limbs and the ellipsoid of a palm for rays, with exact normals.

    Args:
        limbs: Fingers and arm.
        palm_centre: ``(3,)``.
        palm_radii: ``(3,)`` half axes along x, y and z.
    """
    directions, far, faces = _round_template()
    vertices, normals = [], []
    for limb in limbs:
        turned = directions @ _frame_along(limb.end - limb.start)
        joints = np.where(far[:, None], limb.end, limb.start)
        vertices.append(joints + limb.radius * turned)
        normals.append(turned)
    vertices.append(palm_centre + palm_radii * directions)
    outwards = directions / palm_radii
    normals.append(outwards / np.linalg.norm(outwards, axis=1, keepdims=True))
    all_faces = (faces + len(directions) * np.arange(len(limbs) + 1)[:, None, None]).reshape(-1, 3)
    mesh = trimesh.Trimesh(np.concatenate(vertices), all_faces, process=False)
    return RayMesh.of(mesh, np.concatenate(normals))


def _round_template() -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
    """Directions ``(V, 3)`` from the joints along z, which vertices ``(V,)`` belong to the far joint, and faces."""
    heights = 0.5 * np.pi * np.linspace(0, 1, _RINGS + 1)
    latitude = np.concatenate([-heights[::-1], heights])
    angle = 2 * np.pi * np.arange(_AROUND) / _AROUND
    ring = np.stack([np.cos(angle), np.sin(angle)], 1)
    directions = np.concatenate(
        [np.column_stack([np.cos(b) * ring, np.full(_AROUND, np.sin(b))]) for b in latitude.tolist()]
    )
    far = np.repeat(np.arange(len(latitude)) > _RINGS, _AROUND)
    index = np.arange(len(directions)).reshape(len(latitude), _AROUND)
    following = np.roll(index, -1, axis=1)
    a, b, c, d = (part.ravel() for part in (index[:-1], following[:-1], index[1:], following[1:]))
    return directions, far, np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])


def _frame_along(direction: Array) -> Array:
    """Rotation whose rows are two directions across and the unit vector along ``direction`` ``(3,)``."""
    along = direction / max(float(np.linalg.norm(direction)), 1e-12)
    helper = np.eye(3)[np.abs(along).argmin()]
    across = np.cross(helper, along)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(along, across), along])
