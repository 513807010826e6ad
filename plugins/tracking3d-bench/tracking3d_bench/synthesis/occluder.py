"""A hand that comes into the picture from one side, moves over the object and goes again.

It is a solid in front of the object with a path of its own: it hides the object and throws a shadow on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import trimesh
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis.motions import Path
from tracking3d_bench.synthesis.pixel_rays import pixels_around, ray_directions
from tracking3d_bench.synthesis.ray_casting import RayMesh
from tracking3d_bench.synthesis.spec import SequenceSpec

Array = NDArray[np.float64]

MOST_HIDDEN = 0.35
"""Share of the object's pixels that a hand of strength 1 hides in its worst frame."""

_SKIN = np.array([0.62, 0.34, 0.22])  # linear light
_AWAY = 1.4  # distance of the fingertips from the object's centre in its radii while the hand is away
_NEARNESS = 0.88  # depth of the hand relative to that of the object's nearest possible point
_GRID = 30  # pixels per axis with which hidden shares are measured


class Occluder(Protocol):
    """A hand in front of the object."""

    def surface_at(self, time: float) -> RayMesh | None:
        """Its surface in its own coordinates at a time in frames; None if it is nowhere near."""
        ...

    def T_cam_hand(self, time: float) -> Array:
        """Its pose ``(4, 4)`` at a time in frames."""
        ...

    def albedo(self, points: Array) -> Array:
        """Linear colours ``(N, 3)`` of points ``(N, 3)`` in its coordinates."""
        ...


@dataclass(frozen=True, eq=False)
class Hand:
    """A hand and its path; fingertips near the origin, the arm along x, flat in z."""

    surface: RayMesh  # in hand coordinates
    path: Path  # path of the object
    radius: float  # radius of the object
    angle: float  # direction in the image that the hand comes from, in radians
    cycles: int  # how many times it comes and goes
    last: int  # index of the last frame
    scale: float  # size of the hand
    reach: float  # distance of the fingertips from the object's centre at their closest, in object radii

    def surface_at(self, time: float) -> RayMesh:
        """See `Occluder.surface_at`: this hand never bends."""
        return self.surface

    def T_cam_hand(self, time: float) -> Array:
        """Pose ``(4, 4)`` at a time in frames."""
        centre = self.path.T_cam_obj(np.array([time]))[0, :3, 3]
        phase = self.cycles * math.pi * time / self.last
        near = math.sin(phase) ** 2
        angle = self.angle + 0.25 * math.sin(1.7 * phase)
        c, s = math.cos(angle), math.sin(angle)
        depth = _NEARNESS * (centre[2] - self.radius)
        T = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
        distance = _AWAY + near * (self.reach - _AWAY)
        T[:3, 3] = centre * (depth / centre[2]) + self.scale * distance * T[:3, 0]
        return T

    def albedo(self, points: Array) -> Array:
        """Linear colours ``(N, 3)`` of points ``(N, 3)`` in hand coordinates: skin, faintly blotched."""
        waves = np.sin(points @ (np.array([[9.0, 4, 0], [-5, 11, 0], [3, -7, 8]]) / self.scale)).sum(1)
        return _SKIN * (1 + 0.06 * waves[:, None])


def make_hand(spec: SequenceSpec, path: Path, surface: RayMesh, radius: float, camera: Camera) -> Hand | None:
    """The hand of a sequence, reaching as far over the object as its strength asks for; None at strength 0."""
    strength = spec.disturbances.occluder
    if strength == 0:
        return None
    rng = spec.random("occluder")
    last = max(spec.frames - 1, 1)
    start = path.T_cam_obj(np.zeros(1))[0, :3, 3]
    # Measured in the image, the hand's unit of length is about the object's radius.
    scale = _NEARNESS * (start[2] - radius) * radius / start[2]
    solid = RayMesh.of(_hand_mesh().apply_scale(scale))
    angle = rng.uniform(0, 2 * math.pi)
    cycles = max(1, round(last / 40))

    frames = np.unique(np.linspace(0, last, min(last + 1, 12 * cycles)).round())
    rays = [object_rays(surface, T, camera) for T in path.T_cam_obj(frames)]

    def hand(reach: float) -> Hand:
        return Hand(solid, path, radius, angle, cycles, last, scale, reach)

    near, far = -1.3, _AWAY
    for _ in range(10):
        reach = 0.5 * (near + far)
        tried = hand(reach)
        hidden = max(
            hidden_share(solid, tried.T_cam_hand(time), seen) for time, seen in zip(frames, rays, strict=True)
        )
        near, far = (near, reach) if hidden < MOST_HIDDEN * strength else (reach, far)
    return hand(far)


def object_rays(surface: RayMesh, T_cam_obj: Array, camera: Camera) -> Array:
    """Directions ``(N, 3)`` of a coarse grid of rays that meet the object."""
    columns, rows = pixels_around(surface.vertices, T_cam_obj, camera)
    step = max(1, round(math.sqrt(len(columns)) / _GRID))
    columns, rows = pixels_around(surface.vertices, T_cam_obj, camera, step)
    directions = ray_directions(camera, columns.astype(np.float64), rows.astype(np.float64))
    R, t = T_cam_obj[:3, :3], T_cam_obj[:3, 3]
    return directions[surface.is_blocked(np.tile(-R.T @ t, (len(directions), 1)), directions @ R)]


def hidden_share(hand: RayMesh, T_cam_hand: Array, directions: Array) -> float:
    """Share of rays of ``directions`` ``(N, 3)`` from the camera that a hand of a pose ``(4, 4)`` stops."""
    origin = -T_cam_hand[:3, :3].T @ T_cam_hand[:3, 3]
    if not len(directions):
        return 0.0
    return float(
        hand.is_blocked(np.tile(origin, (len(directions), 1)), directions @ T_cam_hand[:3, :3]).mean()
    )


def _hand_mesh() -> trimesh.Trimesh:
    """A hand one unit in size: four fingers, thumb, palm and arm, as overlapping rounded solids."""
    fingers = [(0.14, -0.33, -0.06), (0.02, -0.11, -0.02), (0.0, 0.11, 0.02), (0.1, 0.32, 0.07)]
    parts = [_limb((tip, y + tilt, 0.0), (1.1, y, 0.0), 0.1) for tip, y, tilt in fingers]
    parts.append(_limb((0.65, -0.8, 0.0), (1.25, -0.3, 0.0), 0.12))
    parts.append(_limb((1.4, 0.0, 0.0), (8.0, 0.0, 0.0), 0.3))
    palm = trimesh.creation.icosphere(3).apply_scale((0.5, 0.46, 0.25)).apply_translation((1.2, 0.0, 0.0))
    return trimesh.util.concatenate([*parts, palm]).apply_scale((1.0, 1.0, 0.5))


def _limb(
    start: tuple[float, float, float], end: tuple[float, float, float], radius: float
) -> trimesh.Trimesh:
    """A cylinder with round ends around both points."""
    along = np.subtract(end, start)
    length = float(np.linalg.norm(along))
    turn = trimesh.geometry.align_vectors([0, 0, 1], along)
    turn[:3, 3] = np.mean([start, end], axis=0)
    capsule = trimesh.creation.capsule(length, radius, count=[20, 20])
    # Where a capsule's origin is differs between versions of trimesh.
    return capsule.apply_translation(-capsule.bounds.mean(0)).apply_transform(turn)
