"""A hand that comes to an object, holds it while it is turned, and lets it go.

Four fingers lie on one side of the object and the thumb on the other; where they touch its convex hull is worked out
for every pose, so that fingers roll over what turns between them. The wrist goes along with a turn partly, the
forearm always comes from the same side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis.hand_solid import Limb, hand_surface
from tracking3d_bench.synthesis.motions import Path
from tracking3d_bench.synthesis.occluder import MOST_HIDDEN, hidden_share, object_rays
from tracking3d_bench.synthesis.pick_up import Handling, smooth_step
from tracking3d_bench.synthesis.ray_casting import RayMesh
from tracking3d_bench.synthesis.spec import SequenceSpec

Array = NDArray[np.float64]

# Lengths in sizes of the hand: half of it from wrist to fingertips.
_ROWS = np.array([-0.34, -0.115, 0.115, 0.33])  # of the fingers, along y
_LENGTHS = np.array([0.85, 1.0, 1.05, 0.9])  # of the fingers relative to each other
_THUMB_ROW = -0.2
_FINGER, _THUMB, _WRIST, _SLEEVE = 0.108, 0.125, 0.2, 0.27  # radii
_PALM = (0.42, 0.47, 0.2)
_WRIST_X, _SLEEVE_X = 0.85, 1.12  # along the arm from the knuckles
_OPEN = 0.4  # of fingers and thumb while the hand comes and leaves
_SMALLEST, _LARGEST = 0.6, 1.05  # size of a hand in radii of the object
_SHORTEST, _LONGEST = 0.3, 1.3  # how far the middle finger reaches over the object

_SKINS = np.array(
    [[0.62, 0.34, 0.22], [0.5, 0.25, 0.15], [0.3, 0.14, 0.08], [0.68, 0.42, 0.3]]
)  # linear light
_CLOTHS = np.array([[0.05, 0.06, 0.1], [0.3, 0.3, 0.32], [0.25, 0.06, 0.05], [0.07, 0.16, 0.12]])


@dataclass(frozen=True, eq=False)
class Contacts:
    """Where the hand touches, in its axes around the middle of the grip; M times."""

    times: Array  # (M,) in frames
    # (M, 21): x of the knuckles; how far the object reaches along x at each finger and the thumb; z at the bend,
    # halfway and at the tip of each finger; the same of the thumb, with z the other way round
    values: Array

    def at(self, time: float) -> Array:
        """The values ``(21,)`` at a time."""
        return np.array([np.interp(time, self.times, column) for column in self.values.T])


@dataclass(frozen=True, eq=False)
class GrippingHand:
    """A hand and how it moves; knuckles near its origin, the arm along x, fingers on the side of z.

    Attributes:
        path: Path of the object.
        handling: How the object is handled.
        hull: Convex hull of the object for rays.
        radius: Radius of the object.
        base: ``(3, 3)`` axes of the hand, as columns, before the wrist goes along with a turn.
        size: Size of the hand.
        height: How high the middle of the grip is over the object's centre while it stands.
        way: How far away the hand starts.
        overlap: How far the fingers reach over the object, in sizes of the hand.
        stays: Whether it goes on holding the object at the end.
        skin, cloth: ``(3,)`` linear colours of the hand and the sleeve.
        contacts: Where it touches; None until they are known.
    """

    path: Path
    handling: Handling
    hull: RayMesh
    radius: float
    base: Array
    size: float
    height: float
    way: float
    overlap: float
    stays: bool
    skin: Array
    cloth: Array
    contacts: Contacts | None = None

    def surface_at(self, time: float) -> RayMesh | None:
        """The bent hand in its own coordinates; None while it is away."""
        plan = self.handling.schedule
        if time <= plan.arrive or (time >= plan.gone and not self.stays):
            return None
        return _bent(self, time)

    def T_cam_hand(self, time: float) -> Array:
        """Pose ``(4, 4)`` at a time in frames."""
        T = np.eye(4)
        T[:3, :3], centre = self._grip(time)
        away = self.way * self._distance(time) * (self.base @ (1.0, 0.0, 0.0) + (0, 0.25, 0))
        T[:3, 3] = centre + self._contact(time)[0] * T[:3, 0] + away
        pose: Array = self.path.T_cam_rest(np.array([time]))[0] @ T
        return pose

    def albedo(self, points: Array) -> Array:
        """Linear colours ``(N, 3)`` of points ``(N, 3)`` in hand coordinates: blotched skin, and a sleeve."""
        waves = np.sin(points @ (np.array([[9.0, 4, 0], [-5, 11, 0], [3, -7, 8]]) / self.size)).sum(1)
        skin = self.skin * (1 + 0.06 * waves[:, None])
        return np.where(points[:, :1] > _SLEEVE_X * self.size, self.cloth, skin)

    def touching(self) -> GrippingHand:
        """The same hand with its contacts at all times, smooth in time."""
        plan = self.handling.schedule
        times = np.arange(plan.grasp, plan.released + 1)
        values = np.array([self._contact(time) for time in times])
        # A finger is lifted before an edge comes, not pierced by it.
        values = gaussian_filter1d(_outermost(values), 1.5, axis=0, mode="nearest")
        return replace(self, contacts=Contacts(times, values))

    def opened(self, time: float) -> float:
        """How far the fingers are open, from 0 to 1."""
        plan = self.handling.schedule
        come = plan.grasp - plan.arrive
        opened = 1 - smooth_step(np.array([time]), plan.grasp - 0.3 * come, plan.grasp)[0]
        if not self.stays:
            leave = plan.gone - plan.released
            opened += smooth_step(np.array([time]), plan.released, plan.released + 0.3 * leave)[0]
        return float(opened)

    def forearm(self, time: float) -> Array:
        """Unit direction ``(3,)`` of the forearm in hand axes."""
        R, _ = self._grip(time)
        along: Array = R.T @ (self.base @ (1.0, 0.0, 0.0))
        return along

    def _distance(self, time: float) -> float:
        """How far away the hand is, from 0 to 1."""
        plan = self.handling.schedule
        end = plan.grasp - 0.15 * (plan.grasp - plan.arrive)
        distance = (1 - min(max((time - plan.arrive) / (end - plan.arrive), 0), 1)) ** 2
        if not self.stays:
            start = plan.released + 0.2 * (plan.gone - plan.released)
            distance += min(max((time - start) / (plan.gone - start), 0), 1) ** 2
        return distance

    def _grip(self, time: float) -> tuple[Array, Array]:
        """Axes of the hand ``(3, 3)`` and the middle of its grip ``(3,)``, where the object stood."""
        _, position, raised, follow = self.handling.at(time)
        up = np.array([0.0, self.height * (1 - raised), 0.0])
        return follow.as_matrix() @ self.base, self.radius * position + up

    def _contact(self, time: float) -> Array:
        if self.contacts is not None:
            return self.contacts.at(time)
        R_obj, position, *_ = self.handling.at(time)
        R, centre = self._grip(time)
        to_object = R_obj.T @ R
        return _touch(
            self.hull, to_object, R_obj.T @ (centre - self.radius * position), self.size, self.overlap
        )


def make_grip(
    spec: SequenceSpec, handling: Handling, path: Path, surface: RayMesh, camera: Camera
) -> GrippingHand | None:
    """The hand of a ``pick_up``, reaching as far over the object as its strength asks for; None at strength 0."""
    strength = spec.disturbances.occluder
    if strength == 0:
        return None
    rng = spec.random("occluder")
    radius = float(np.linalg.norm(surface.vertices, axis=1).max())
    size = radius * _SMALLEST
    start = path.T_cam_rest(np.zeros(1))[0]
    base = _side(rng, start[:3, :3])
    lowest = radius * _LARGEST * (abs(_ROWS[0]) * abs(base[1, 1]) + _FINGER)
    height = max(0.0, lowest + surface.vertices[:, 1].min() + 0.05 * radius)
    edge = 0.5 * max(camera.width / camera.fx, camera.height / camera.fy) * start[2, 3]
    hand = GrippingHand(
        path,
        handling,
        RayMesh.of(surface.intersector.mesh.convex_hull),
        radius,
        base,
        size,
        height,
        1.3 * edge + 1.5 * radius,
        _SHORTEST,
        bool(rng.random() < 0.4),
        _SKINS[rng.integers(len(_SKINS))],
        _CLOTHS[rng.integers(len(_CLOTHS))],
    )
    return _reaching(hand, surface, camera, MOST_HIDDEN * strength)


def _reaching(hand: GrippingHand, surface: RayMesh, camera: Camera, wanted: float) -> GrippingHand:
    """The hand whose fingers hide as much as ``wanted`` of the object in the worst frame, or nearly.

    A larger hand reaches farther; how much the smallest one hides is no matter of choice.
    """
    plan = hand.handling.schedule
    times = np.linspace(plan.grasp, plan.released, 9).round()
    poses = hand.path.T_cam_obj(times)
    seen = [object_rays(surface, T, camera) for T in poses]

    def grown(share: float) -> GrippingHand:
        size = hand.radius * (_SMALLEST + share * (_LARGEST - _SMALLEST))
        return replace(hand, size=size, overlap=_SHORTEST + share * (_LONGEST - _SHORTEST))

    def worst(tried: GrippingHand) -> float:
        pairs = zip(times.tolist(), seen, strict=True)
        return max(hidden_share(_bent(tried, time), tried.T_cam_hand(time), rays) for time, rays in pairs)

    low, high = 0.0, 1.0
    for _ in range(5):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if worst(grown(middle)) < wanted else (low, middle)
    return grown(low).touching()


def _side(rng: np.random.Generator, R_cam_rest: Array) -> Array:
    """Axes ``(3, 3)`` of a hand that comes from the right or left and from above, in those of the table."""
    right, near = R_cam_rest[0], -R_cam_rest[2]
    side = rng.choice([-1.0, 1.0])
    aside, up = math.radians(rng.uniform(-5, 35)), math.radians(rng.uniform(15, 40))
    level = [v * (1, 0, 1) / np.linalg.norm(v * (1, 0, 1)) for v in (right, near)]
    sideways = math.cos(aside) * side * level[0] + math.sin(aside) * level[1]
    x = math.cos(up) * sideways + np.array([0, math.sin(up), 0])
    # The fingers are on the side of the camera, or on the far side and the thumb before the object.
    front = near if rng.random() < 0.6 else -near
    z = front - (front @ x) * x
    z /= np.linalg.norm(z)
    y = np.cross(z, x)
    return np.stack([x, y, z], 1)


def _touch(hull: RayMesh, R_obj_hand: Array, middle: Array, size: float, overlap: float) -> Array:
    """`Contacts.values` of one time.

    Args:
        hull: The object's.
        R_obj_hand: ``(3, 3)`` axes of the hand in those of the object.
        middle: ``(3,)`` middle of the grip in object coordinates.
        size: Size of the hand.
        overlap: How far fingers reach over the object, in sizes.
    """
    far = 4 * float(np.linalg.norm(hull.vertices, axis=1).max())

    def cast(origins: Array, direction: tuple[int, int, int]) -> Array:
        """How far rays from ``origins`` ``(N, 3)`` in hand axes get; 0 is where ``far`` of them is used up."""
        along = np.tile(R_obj_hand @ direction, (len(origins), 1)).astype(np.float64)
        hits = hull.cast(origins @ R_obj_hand.T + middle, along)
        return np.where(hits.face >= 0, far - hits.distance, 0.0)

    rows = size * np.append(_ROWS, _THUMB_ROW)
    edge = cast(np.column_stack([np.full(5, far), rows, np.zeros(5)]), (-1, 0, 0))
    edge = np.maximum(edge, edge.max() - 0.3 * size)  # a finger next to the object goes along with the others
    lengths = size * overlap * np.append(_LENGTHS, 0.6)
    x = edge[:, None] - np.stack([np.full(5, 0.08 * size), 0.5 * lengths, lengths], 1)
    over = np.column_stack([x[:4].ravel(), np.repeat(rows[:4], 3), np.full(12, far)])
    under = np.column_stack([x[4], np.repeat(rows[4], 3), np.full(3, -far)])
    above, below = cast(over, (0, 0, -1)), cast(under, (0, 0, 1))
    return np.concatenate([[edge[:4].max() + 0.16 * size], edge, above, below])


def _outermost(values: Array) -> Array:
    """Contacts ``(M, 21)`` as far from the object as the neighbouring times demand."""
    return np.asarray(maximum_filter1d(values, 3, axis=0, mode="nearest"))


@lru_cache(maxsize=2)
def _bent(hand: GrippingHand, time: float) -> RayMesh:
    """The hand's surface, its fingers bent to what they touch."""
    s, x0, *rest = hand.size, *hand._contact(time)
    edge, above, below = np.array(rest[:5]), np.array(rest[5:17]).reshape(4, 3), np.array(rest[17:])
    opened = hand.opened(time) * _OPEN * s
    lengths = s * hand.overlap * np.append(_LENGTHS, 0.6)
    x = edge[:, None] - np.stack([np.full(5, 0.08 * s), 0.5 * lengths, lengths], 1) - x0
    limbs = []
    spread = np.array([0.4, 0.8, 1.0]) * opened
    for k, row in enumerate(s * _ROWS):
        lift = 0.9 * _FINGER * s + spread
        joints = np.column_stack([x[k], np.full(3, row), above[k] + lift])
        knuckle = np.array([0.05 * s, row, 0.04 * s])
        points = [knuckle, *joints]
        limbs += [Limb(a, b, _FINGER * s) for a, b in pairwise(points)]
    lift = 0.9 * _THUMB * s + spread
    joints = np.column_stack([x[4], s * _THUMB_ROW * np.ones(3), -below - lift])
    points = [np.array([0.5, -0.3, -0.08]) * s, *joints]
    limbs += [Limb(a, b, _THUMB * s) for a, b in pairwise(points)]
    limbs.append(Limb(np.array([0.05, _ROWS[0], 0.02]) * s, np.array([0.05, _ROWS[3], 0.02]) * s, 0.13 * s))
    along = hand.forearm(time)
    wrist = np.array([_WRIST_X * s, 0.0, 0.0])
    elbow = wrist + (hand.way + 2 * s) * along
    limbs.append(Limb(np.array([0.5 * s, 0.0, 0.0]), wrist, _WRIST * s))
    limbs.append(Limb(wrist, elbow, _WRIST * s))
    limbs.append(Limb(wrist + 0.55 * s * along, elbow, _SLEEVE * s))
    return hand_surface(limbs, np.array([0.42, 0.0, 0.0]) * s, s * np.array(_PALM))
