"""The motion ``pick_up``: an object stands on a table, is lifted, turned with pauses and put down again.

A hand-held camera films it. Poses are planned in the axes of the object as it stood in frame 0, whose y is up, with
the object's radius as unit of length and frames as unit of time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis.motions import STEPS, Path, waves
from tracking3d_bench.synthesis.solid import Solid
from tracking3d_bench.synthesis.spec import SequenceSpec

Array = NDArray[np.float64]

PICK_UP = "pick_up"

# Shares of the frames after the still ones: the hand comes, lifts, turns and puts down; in the rest it leaves.
_COME, _LIFT, _TURN, _LOWER = 0.13, 0.1, 0.5, 0.11

_PAUSES = 0.36  # share of the turning time before, between and after the turns
_LARGEST_TURN = math.radians(120)
_OTHER_SIDE = 60  # degrees that the object is turned at the end at least
_CLEARANCE = 1.2  # height of the object's centre over the table while it turns; its radius is 1
_FOLLOW, _LARGEST_FOLLOW = 0.45, math.radians(35)  # how far the wrist goes along with a turn
_SHAKE = 0.006  # of the camera's direction, relative to the vertical field of view


@dataclass(frozen=True)
class Schedule:
    """When what happens, in frames; nothing moves but the camera before `arrive`."""

    arrive: float  # the hand sets out
    grasp: float  # it holds the object, which rises
    lifted: float  # the object begins to turn
    lower: float  # it sinks
    released: float  # it stands again, and the hand lets go
    gone: float  # the hand is out of the picture

    @classmethod
    def of(cls, spec: SequenceSpec) -> Schedule:
        """The schedule of a sequence."""
        last = max(spec.frames - 1, 1)
        start = float(min(spec.still_frames, last // 2))
        grasp, lifted, lower, released = start + (last - start) * np.cumsum([_COME, _LIFT, _TURN, _LOWER])
        return cls(start, float(grasp), float(lifted), float(lower), float(released), float(last))


@dataclass(frozen=True, eq=False)
class Handling:
    """How an object is handled."""

    schedule: Schedule  # when
    times: Array  # (M,) in frames
    rotations: Rotation  # m rotations of the object from where it stood
    positions: Array  # (M, 3) of its origin relative to where it stood, in its radii
    raised: Array  # (M,) from 0 on the table to 1 at full height
    # (M, 3) rotation vectors of the hand that holds it: the wrist goes along with a turn partly, and turns back in
    # the pause after it
    follow: Array

    @cached_property
    def _rotation(self) -> Slerp:
        return Slerp(self.times, self.rotations)

    @cached_property
    def _columns(self) -> Array:
        return np.column_stack([self.positions, self.raised, self.follow]).T.copy()

    def at(self, time: float) -> tuple[Array, Array, float, Rotation]:
        """Rotation ``(3, 3)`` and position ``(3,)`` of the object, how far it is raised, how far the hand turned."""
        time = float(np.clip(time, self.times[0], self.times[-1]))
        R = self._rotation([time]).as_matrix()[0]
        *values, a, b, c = (float(np.interp(time, self.times, column)) for column in self._columns)
        return R, np.array(values[:3]), values[3], Rotation.from_rotvec([a, b, c])


def plan_pick_up(spec: SequenceSpec, solid: Solid, camera: Camera) -> tuple[Path, Handling]:
    """The path of the object in front of the camera, and what the hand has to know of it.

    In frame 0 the object's enclosing sphere is in the middle of the image and fills `SequenceSpec.fill` of its
    height, as with all motions.
    """
    rng = spec.random("motion")
    last = max(spec.frames - 1, 1)
    times = np.linspace(-1, last + 1, STEPS * (last + 2) + 1)
    rest = _hand_held_camera(spec, camera, times, rng)
    towards = rest.rotations[STEPS].inv().as_matrix()  # of the camera's axes in frame 0, as columns
    schedule = Schedule.of(spec)
    rotations, follow = _turns(spec, schedule, times, towards, rng)
    height = -float(solid.vertices[:, 1].min()) / solid.radius
    positions, raised = _carry(schedule, times, towards, height, rng)
    handling = Handling(schedule, times, rotations, positions, raised, follow)
    placed = rest.positions + rest.rotations.apply(positions)
    radius = solid.radius
    still = Path(times, rest.rotations, radius * rest.positions)
    return Path(times, rest.rotations * rotations, radius * placed, still), handling


def smooth_step(times: Array, start: float, end: float) -> Array:
    """From 0 at ``start`` to 1 at ``end`` with neither speed nor acceleration at the ends, ``(M,)``."""
    share = ((times - start) / max(end - start, 1e-9)).clip(0, 1)
    steps: Array = share**3 * (10 + share * (6 * share - 15))
    return steps


def _hand_held_camera(spec: SequenceSpec, camera: Camera, times: Array, rng: np.random.Generator) -> Path:
    """Poses of the table: seen from 25 to 42 degrees above, by a camera that shakes."""
    view = [rng.uniform(0, 360), 180 + rng.uniform(25, 42), rng.uniform(-4, 4)]
    start = Rotation.from_euler("yxz", view, degrees=True)
    depth = math.hypot(1.0, 2 * camera.fy / (spec.fill * camera.height))
    sizes = _SHAKE * math.radians(spec.fov) * np.array([1.0, 0.8, 0.8])
    turns = np.stack([_shake(times, rng, size) for size in sizes], 1)
    moves = np.stack([_shake(times, rng, size) for size in (0.03, 0.03, 0.004 * depth)], 1)
    shake = Rotation.from_rotvec(turns - turns[STEPS])
    positions = shake.apply([0, 0, depth]) + moves - moves[STEPS]
    return Path(times, shake * start, positions)


def _shake(times: Array, rng: np.random.Generator, size: float) -> Array:
    """``(M,)`` a slow drift, the sway of an arm and a little tremor."""
    return (
        waves(times, rng, size, (70, 130))
        + waves(times, rng, 0.4 * size, (18, 35))
        + waves(times, rng, 0.08 * size, (5, 9))
    )


def _turns(
    spec: SequenceSpec, schedule: Schedule, times: Array, towards: Array, rng: np.random.Generator
) -> tuple[Rotation, Array]:
    """Rotations of the object and of the hand that follows it partly: turns about changing axes, with pauses.

    The last turn brings the object upright again, seen from another side than at first.
    """
    window = schedule.lower - schedule.lifted
    wanted = math.radians(spec.degrees_per_frame) * window * (1 - _PAUSES)
    count = max(2, math.ceil(wanted / _LARGEST_TURN))
    vectors, turned = [], Rotation.identity()
    for k in range(count - 1):
        # By turns about an upright and a level axis of the image; a turn about the line of sight shows no new side.
        axis = np.array([0.25, 1.0, 0.2] if k % 2 else [1.0, 0.25, 0.2]) * rng.choice([-1, 1], 3)
        axis = towards @ (axis + rng.uniform(-0.2, 0.2, 3))
        vectors.append(wanted / count * axis / np.linalg.norm(axis))
        turned = Rotation.from_rotvec(vectors[-1]) * turned
    vectors.append(_upright_again(turned, wanted / count))
    angles = np.linalg.norm(vectors, axis=1).clip(1e-9)
    pause = _PAUSES * window / (count + 1)
    lengths = (1 - _PAUSES) * window * angles / angles.sum()

    tremor = smooth_step(times, schedule.grasp, schedule.lifted) * (
        1 - smooth_step(times, schedule.lower, schedule.released)
    )
    shivers = np.stack([waves(times, rng, math.radians(0.3), (18, 40)) for _ in range(3)], 1)
    rotations = Rotation.from_rotvec(tremor[:, None] * shivers)
    follow = np.zeros((len(times), 3))
    start, turned = schedule.lifted + pause, Rotation.identity()
    for vector, angle, length in zip(vectors, angles, lengths, strict=True):
        done = _one_turn(times, start, start + length)
        turned = Rotation.from_rotvec(done[:, None] * vector) * turned
        back = smooth_step(times, start + length, start + length + pause)
        follow += (done - back)[:, None] * vector * min(_FOLLOW, _LARGEST_FOLLOW / angle)
        start += length + pause
    return rotations * turned, follow


def _upright_again(turned: Rotation, wanted: float) -> Array:
    """The rotation vector ``(3,)`` of nearly the ``wanted`` angle after which y is up again, and another side seen."""
    ends = Rotation.from_euler("y", np.arange(_OTHER_SIDE, 361 - _OTHER_SIDE, 5)[:, None], degrees=True)
    vectors = (ends * turned.inv()).as_rotvec()
    best: Array = vectors[np.abs(np.linalg.norm(vectors, axis=1) - wanted).argmin()]
    return best


def _one_turn(times: Array, start: float, end: float) -> Array:
    """Share of a turn that is done ``(M,)``: steady in its middle half, with gentle ends."""
    x = np.linspace(0, 1, 400)
    speed = smooth_step(x, 0, 0.25) * (1 - smooth_step(x, 0.75, 1))
    done = np.cumsum(speed) - speed[0]
    share: Array = np.interp((times - start) / max(end - start, 1e-9), x, done / done[-1])
    return share


def _carry(
    schedule: Schedule, times: Array, towards: Array, height: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Where the object is relative to where it stood ``(M, 3)``, and how far it is raised ``(M,)``."""
    raised = smooth_step(times, schedule.grasp, schedule.lifted) * (
        1 - smooth_step(times, schedule.lower, schedule.released)
    )
    moved = smooth_step(times, schedule.lifted, schedule.lower)
    up = np.array([0.0, 1.0, 0.0])
    right, near = _level(towards[:, 0]), _level(-towards[:, 2])
    rise = max(_CLEARANCE - height, 0.3) + rng.uniform(0.05, 0.3)
    lift = rise * up + rng.uniform(0.1, 0.7) * near + rng.uniform(-0.3, 0.3) * right
    put = rng.uniform(-0.3, 0.3) * right + rng.uniform(-0.2, 0.3) * near
    sway = np.stack([waves(times, rng, 0.06, (30, 60)) for _ in range(3)], 1)
    positions: Array = raised[:, None] * (lift + sway) + moved[:, None] * put
    return positions, raised


def _level(direction: Array) -> Array:
    """The level part of a direction ``(3,)``, of unit length."""
    level = direction * (1, 0, 1)
    unit: Array = level / np.linalg.norm(level)
    return unit
