"""Procedural objects whose shape comes from the seed: no two sequences show the same one.

They are about one unit in radius, y is up, and the middle of their bounding box is the origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tracking3d_bench.synthesis.patches import (
    Array,
    Patch,
    cube_sphere,
    prism,
    rectangle,
    revolve,
    subdivide_polyline,
    tube,
)

_RADIUS = 0.95  # of the sphere around the origin that holds an object

_Span = tuple[float, float]

_ASSEMBLIES: dict[str, list[tuple[_Span, _Span, _Span]]] = {
    "chair": [
        ((-0.5, 0.5), (-0.1, 0.1), (-0.5, 0.5)),
        ((-0.47, 0.47), (-0.02, 0.95), (-0.48, -0.3)),
        ((-0.46, -0.24), (-0.9, 0.0), (-0.46, -0.24)),
        ((0.24, 0.46), (-0.9, 0.0), (-0.46, -0.24)),
        ((-0.46, -0.24), (-0.9, 0.0), (0.24, 0.46)),
        ((0.24, 0.46), (-0.9, 0.0), (0.24, 0.46)),
    ],
    "bracket": [
        ((-0.7, 0.7), (-0.7, -0.42), (-0.45, 0.45)),
        ((-0.67, -0.38), (-0.6, 0.8), (-0.42, 0.42)),
        ((-0.5, 0.15), (-0.55, 0.0), (-0.14, 0.14)),
    ],
    "channel": [
        ((-0.6, 0.6), (-0.6, -0.3), (-0.7, 0.7)),
        ((-0.57, -0.3), (-0.5, 0.6), (-0.67, 0.67)),
        ((0.3, 0.57), (-0.5, 0.35), (-0.67, 0.67)),
    ],
    "steps": [
        ((-0.7, 0.7), (-0.65, -0.2), (-0.5, 0.5)),
        ((-0.67, 0.25), (-0.35, 0.25), (-0.47, 0.47)),
        ((-0.64, -0.2), (0.1, 0.7), (-0.44, 0.44)),
    ],
    "cross": [
        ((-0.8, 0.6), (-0.17, 0.17), (-0.2, 0.2)),
        ((-0.2, 0.14), (-0.6, 0.8), (-0.15, 0.15)),
        ((-0.14, 0.16), (-0.13, 0.14), (-0.35, 0.75)),
    ],
    "hook": [
        ((-0.7, 0.2), (0.42, 0.75), (-0.35, 0.35)),
        ((-0.16, 0.17), (-0.6, 0.6), (-0.3, 0.3)),
        ((-0.13, 0.7), (-0.75, -0.42), (-0.26, 0.4)),
    ],
}
"""Boxes by their spans along x, y and z. They overlap by more than their faces are moved, and none are flush."""


def organic(rng: np.random.Generator) -> list[Patch]:
    """A stone, a fruit, a toy animal without its details: bumps and dents of many widths on a stretched ball."""
    count = 22
    centres = rng.normal(size=(count, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    narrowness = np.exp(rng.uniform(math.log(2), math.log(28), count))
    heights = 0.75 * rng.normal(size=count) / narrowness**0.4
    stretch = rng.uniform(0.55, 1, 3)
    patches = []
    for patch in cube_sphere(36):
        # An exponential of exponentials, so that no dent reaches the centre.
        shape = np.exp(np.exp(narrowness * (patch.vertices @ centres.T - 1)) @ heights.clip(-0.5, 0.6))
        patches.append(Patch(stretch * patch.vertices * shape[:, None], patch.faces, patch.uvs))
    return _fit_in_unit_ball(patches)


def assembly(rng: np.random.Generator) -> list[Patch]:
    """A chair, bracket, channel, stairs, cross or hook of overlapping boxes, each of its own proportions."""
    boxes = np.array(_ASSEMBLIES[str(rng.choice(list(_ASSEMBLIES)))])
    boxes += rng.uniform(-0.02, 0.02, boxes.shape)
    mirrored = rng.choice([-1.0, 1.0], 3) * (1, 0, 1) + (0, 1, 0)
    boxes *= (rng.uniform(0.6, 1, 3) * mirrored)[:, None]
    return _fit_in_unit_ball([patch for box in np.sort(boxes, axis=2) for patch in _block(box)])


def stick(rng: np.random.Generator) -> list[Patch]:
    """A long thin thing with round ends: bent, thicker at one end, its bend all the way or in the middle."""
    along = 1 - np.cos(np.linspace(0, math.pi, 121))  # closer at the ends, where it is round
    along = (along - 1)[:, None]
    bend = rng.uniform(0.3, 1.9)
    abruptness = rng.uniform(0.5, min(6, 5.6 / bend))  # a bend sharper than the stick is thick would fold it
    direction = 0.5 * bend * np.tanh(abruptness * along) / np.tanh(abruptness)
    steps = np.diff(along, axis=0) * np.hstack([np.cos(direction[:-1]), np.sin(direction[:-1])])
    curve = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    thickness = rng.uniform(0.08, 0.16) * (1 + rng.uniform(0.1, 0.5) * np.tanh(rng.uniform(1, 6) * along))
    ends = np.sqrt((1 - along**8).clip(0))
    ends[[0, -1]] = 0
    curve = np.column_stack([curve, np.zeros(len(curve))])
    upright = curve @ _turn(rng.uniform(0, 2 * math.pi)).T
    return _fit_in_unit_ball(tube(upright, thickness * ends, np.array([0.0, 0.0, 1.0]), steps=28, sections=4))


def knob(rng: np.random.Generator) -> list[Patch]:
    """A regular prism or a turned body, and one small nub, the only thing that tells where its front is."""
    half_height = rng.uniform(0.3, 0.75)
    height = np.linspace(-half_height, half_height, 25)
    if rng.random() < 0.5:
        sides = int(rng.integers(3, 9))
        angle = 2 * math.pi * (np.arange(sides) + 0.5) / sides
        body = prism(0.6 * np.stack([np.cos(angle), np.sin(angle)], 1), half_height)
        body = [Patch(patch.vertices @ _UPRIGHT.T, patch.faces, patch.uvs) for patch in body]
        girth = np.full(25, 0.6 * math.cos(math.pi / sides))
    else:
        waves, phase = rng.uniform(0.5, 1.5), rng.uniform(0, 2 * math.pi)
        girth = 0.5 * (1 + 0.25 * np.sin(waves * math.pi * height / half_height + phase))
        profile = np.column_stack([girth, height])
        ends = (0.0, -half_height), (0.0, half_height)
        body = revolve(subdivide_polyline(np.vstack([ends[0], profile, ends[1]])), sectors=2)
    size = rng.uniform(0.09, 0.15)
    if rng.random() < 0.5:  # at the side, else on top
        middle = 0.5 * float(rng.uniform(-1, 1)) * half_height
        reach = float(np.interp(middle, height, girth))
        spans = (0.5 * reach, reach + 1.4 * size), (middle - size, middle + size)
    else:
        reach = 0.5 * float(girth[-1])
        spans = (reach - size, reach + size), (half_height - 0.1, half_height + 1.4 * size)
    return _fit_in_unit_ball([*body, *_block(np.array([*spans, (-size, size)]))])


def bowl(rng: np.random.Generator) -> list[Patch]:
    """A bowl, dish or cup without a handle: deep or flat, steep or wide."""
    foot, depth, power = rng.uniform(0.2, 0.5), rng.uniform(0.25, 1.1), rng.uniform(0.35, 1)
    rim, wall = 0.85, rng.uniform(0.05, 0.09)
    share = np.linspace(0, 1, 25)
    outside = np.column_stack([foot + (rim - foot) * share**power, depth * share])
    inner_foot, inner_rim = foot - 0.5 * wall, rim - wall
    inside = np.column_stack(
        [inner_foot + (inner_rim - inner_foot) * share**power, wall + (depth - wall) * share]
    )
    profile = np.vstack([(0.0, 0.0), outside, inside[::-1], (0.0, wall)])
    return _fit_in_unit_ball(revolve(subdivide_polyline(profile), sectors=2))


_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Turns z to y."""


def _turn(angle: float) -> Array:
    """A rotation about z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _block(spans: Array) -> list[Patch]:
    """The box of the spans ``(3, 2)``."""
    middle, half = spans.mean(1), 0.5 * (spans[:, 1] - spans[:, 0])
    sides = prism(rectangle(half[0], half[1]), half[2])
    return [Patch(patch.vertices + middle, patch.faces, patch.uvs) for patch in sides]


def _fit_in_unit_ball(patches: Sequence[Patch]) -> list[Patch]:
    """The same in the middle, and of the radius of all."""
    vertices = np.concatenate([patch.vertices for patch in patches])
    middle = 0.5 * (vertices.min(0) + vertices.max(0))
    scale = _RADIUS / np.linalg.norm(vertices - middle, axis=1).max()
    return [Patch(scale * (patch.vertices - middle), patch.faces, patch.uvs) for patch in patches]
