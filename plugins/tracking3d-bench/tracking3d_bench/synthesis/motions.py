"""How objects move: smooth paths of poses, evaluated at any time, so that a shutter can stay open.

Or how a camera moves round a still object, which the same poses describe.

Time is counted in frames. Rotations turn the object about its centre in camera axes; positions are given
relative to where the object's enclosing sphere fills the asked share of the image height, in its radii.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis.spec import SequenceSpec

Array = NDArray[np.float64]

STEPS = 16
"""Points of a path per frame; between them rotations are interpolated along the shortest arc."""


@dataclass(frozen=True, eq=False)
class Path:
    """Poses over time."""

    times: Array  # (M,) in frames, increasing
    rotations: Rotation  # m rotations, object to camera axes
    positions: Array  # (M, 3) of the object's origin in camera coordinates
    # path of the place where the object stood in frame 0, in the object's axes of that frame; None if object and
    # surroundings are one
    rest: Path | None = None

    def T_cam_obj(self, times: Array) -> Array:
        """Poses ``(N, 4, 4)`` at ``times`` ``(N,)``; what is beyond the ends takes the pose at the end."""
        times = np.clip(times, self.times[0], self.times[-1])
        poses = np.tile(np.eye(4), (len(times), 1, 1))
        poses[:, :3, :3] = Slerp(self.times, self.rotations)(times).as_matrix()
        for k in range(3):
            poses[:, k, 3] = np.interp(times, self.times, self.positions[:, k])
        return poses

    def T_cam_rest(self, times: Array) -> Array:
        """Poses ``(N, 4, 4)`` of the surroundings: those of the object if it never leaves its place."""
        return (self.rest or self).T_cam_obj(times)


def make_path(spec: SequenceSpec, camera: Camera, radius: float) -> Path:
    """The path of an object of this ``radius``; it reaches half a frame beyond both ends of the sequence.

    In frame 0 the object's enclosing sphere is in the middle of the image and fills `SequenceSpec.fill` of its
    height. The path of ``pick_up`` depends on more than the radius: see `tracking3d_bench.synthesis.pick_up`.
    """
    rng = spec.random("motion")
    last = max(spec.frames - 1, 1)
    times = np.linspace(-1, last + 1, STEPS * (last + 2) + 1)
    first = STEPS
    spin = _SPINS[spec.motion](times, last, math.radians(spec.degrees_per_frame), rng)
    walk = spec.motion == "walk_round"
    if walk:
        rotations = _random_walk(times, spin, rng)
    else:
        turned = _integrate(spin * (times[1] - times[0]))
        start = Rotation.from_euler("yxz", _views(spec.motion, rng), degrees=True)
        rotations = turned * turned[first].inv() * start

    # A sphere of radius 1 at depth d has an outline of radius f / sqrt(d^2 - 1).
    depth = math.hypot(1.0, 2 * camera.fy / (spec.fill * camera.height))
    path = _hand_shake(times, rng, depth) if walk else _sway(times, rng, depth)
    if spec.motion == "depth_drift":
        path[:, 2] += 1.1 * depth * np.sin(0.5 * math.pi * times / last) ** 2
    if spec.motion == "leave_and_return":
        path[:, 0] += rng.choice([-1.0, 1.0]) * _way_out(camera, depth) * np.sin(math.pi * times / last) ** 2
    path -= path[first]
    path[:, 2] += depth
    return Path(times, rotations, radius * path)


def _tumble(times: Array, last: int, speed: float, rng: np.random.Generator) -> Array:
    """Steady speed about an axis that wanders."""
    return speed * _wandering_axis(times, rng, period=70.0)


def _fast(times: Array, last: int, speed: float, rng: np.random.Generator) -> Array:
    """Bursts: the speed swings between a tenth of the peak and the peak every dozen frames."""
    phase = rng.uniform(0, 2 * math.pi)
    bursts = 0.55 - 0.45 * np.cos(2 * math.pi * times / 12 + phase)
    return speed * bursts[:, None] * _wandering_axis(times, rng, period=50.0)


def _turntable(times: Array, last: int, speed: float, rng: np.random.Generator) -> Array:
    """Steady speed about the turntable's axis, seen from above."""
    return np.tile(speed * _TABLE_AXIS * rng.choice([-1.0, 1.0]), (len(times), 1))


def _turn_and_back(times: Array, last: int, speed: float, rng: np.random.Generator) -> Array:
    """The turntable until half of the sequence, then back to where it was."""
    return _turntable(times, last, speed, rng) * np.tanh((0.5 * last - times) / 1.5)[:, None]


def _flip(times: Array, last: int, speed: float, rng: np.random.Generator) -> Array:
    """Over and over about an axis in the image, slow when a side faces the camera and fast when on edge."""
    mean = speed * (times - times[STEPS])
    angle = rng.uniform(-0.5, 0.5)
    axis = np.array([math.sin(angle), math.cos(angle), 0.0])
    return speed * (1 - 0.6 * np.cos(2 * mean))[:, None] * axis


def _walk(times: Array, last: int, speed: float, rng: np.random.Generator) -> Array:
    """Round the object at a pace that is not quite steady; the camera's walk as seen from the camera."""
    pace = 1 + 0.25 * np.sin(2 * math.pi * times / rng.uniform(18, 30) + rng.uniform(0, 2 * math.pi))
    return speed * rng.choice([-1.0, 1.0]) * pace[:, None] * (0.0, 1.0, 0.0)


def _random_walk(times: Array, spin: Array, rng: np.random.Generator) -> Rotation:
    """Rotations of a still object that a camera walks round: upright but for the hand that holds the camera."""
    azimuth = np.degrees(np.cumsum(spin[:, 1]) * (times[1] - times[0]))
    azimuth += rng.uniform(0, 360) - azimuth[STEPS]
    height = rng.uniform(14, 34) + waves(times, rng, 4.0, (35, 60)) + waves(times, rng, 0.25, (5, 9))
    roll = rng.uniform(-2, 2) + waves(times, rng, 1.2, (15, 30)) + waves(times, rng, 0.25, (5, 9))
    return Rotation.from_euler("yxz", np.stack([azimuth, 180 + height, roll], 1), degrees=True)


def _hand_shake(times: Array, rng: np.random.Generator, depth: float) -> Array:
    """How a hand-held camera misses its aim and comes nearer and goes farther ``(M, 3)``."""
    aim = [waves(times, rng, size, (20, 45)) + waves(times, rng, 0.015, (5, 9)) for size in (0.12, 0.08)]
    return np.stack([*aim, waves(times, rng, 0.07 * depth, (30, 60))], 1)


def waves(times: Array, rng: np.random.Generator, size: float, periods: tuple[float, float]) -> Array:
    """``(M,)`` up to ``size`` up and down."""
    wave: Array = size * np.sin(2 * math.pi * times / rng.uniform(*periods) + rng.uniform(0, 2 * math.pi))
    return wave


_SPINS: dict[str, Callable[[Array, int, float, np.random.Generator], Array]] = {
    "tumble": _tumble,
    "turntable": _turntable,
    "turn_and_back": _turn_and_back,
    "flip": _flip,
    "fast": _fast,
    "depth_drift": _tumble,
    "leave_and_return": _tumble,
    "walk_round": _walk,
}
"""Angular velocity ``(M, 3)`` in radians a frame by motion."""

_TABLE_VIEW = 25.0  # degrees from above
_TABLE_AXIS = np.array([0.0, -math.cos(math.radians(_TABLE_VIEW)), -math.sin(math.radians(_TABLE_VIEW))])


def _views(motion: str, rng: np.random.Generator) -> Array:
    """Euler angles y, x, z of the first view in degrees; y of the object is up, so x turns by about 180."""
    if motion in ("turntable", "turn_and_back"):
        return np.array([rng.uniform(0, 360), 180 + _TABLE_VIEW, 0.0])
    if motion == "flip":
        return np.array([rng.uniform(-10, 10), 180 + rng.uniform(-15, 15), rng.uniform(-15, 15)])
    return np.array(
        [rng.choice([-1, 1]) * rng.uniform(20, 40), 180 + rng.uniform(15, 35), rng.uniform(-15, 15)]
    )


def _wandering_axis(times: Array, rng: np.random.Generator, period: float) -> Array:
    """Unit vectors ``(M, 3)`` that turn slowly away from a random one."""
    start = rng.normal(size=3)
    start[2] *= 0.4  # a turn about the line of sight shows no new side
    axes = start / np.linalg.norm(start) + 0.6 * np.sin(
        2 * math.pi * times[:, None] / (period * rng.uniform(0.7, 1.3, 3)) + rng.uniform(0, 2 * math.pi, 3)
    )
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def _integrate(steps: Array) -> Rotation:
    """Rotations after none, one, ... of the small rotation vectors ``(M, 3)`` in camera axes."""
    turned = [np.eye(3)]
    for R in Rotation.from_rotvec(steps[:-1]).as_matrix():
        turned.append(R @ turned[-1])
    return Rotation.from_matrix(np.array(turned))


def _sway(times: Array, rng: np.random.Generator, depth: float) -> Array:
    """A small smooth movement ``(M, 3)``."""
    periods, phases = rng.uniform(40, 90, 3), rng.uniform(0, 2 * math.pi, 3)
    return np.array([0.15, 0.1, 0.04 * depth]) * np.sin(2 * math.pi * times[:, None] / periods + phases)


def _way_out(camera: Camera, depth: float) -> float:
    """How far to the side the object is well out of the image, in radii."""
    slope = 0.5 * camera.width / camera.fx
    # The frustum's side plane is then farther from the centre than the radius.
    return 1.1 * (slope * depth + math.hypot(1.0, slope))
