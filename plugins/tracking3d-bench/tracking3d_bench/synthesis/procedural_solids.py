"""Procedural objects: box, bottle, blob, mug, card, wedge and vase.

Those of `tracking3d_bench.synthesis.random_solids` join them.

They are about one unit in radius, y is up. The shapes of the former are fixed but for the blob's; the blob's, those of
the latter and all textures come from the seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from tracking3d.testing.synthesis.procedural_texture import paint_bands, paint_panel, paint_plain
from tracking3d_bench.synthesis.labels import stick_label
from tracking3d_bench.synthesis.patches import (
    Array,
    Patch,
    assemble,
    cube_sphere,
    prism,
    rectangle,
    revolve,
    subdivide_polyline,
    tube,
)
from tracking3d_bench.synthesis.random_solids import assembly, bowl, knob, organic, stick
from tracking3d_bench.synthesis.solid import Solid
from tracking3d_bench.synthesis.spec import SequenceSpec

PANEL = 256
"""Side of a panel of texture in texels."""

MILLIMETRES = 100.0
"""Length of the unit."""

_STEPS_AROUND = 72  # of a continuous symmetry in its list of transforms: every 5 degrees


def box(rng: np.random.Generator) -> list[Patch]:
    """A cuboid of three different sides."""
    return prism(rectangle(0.62, 0.48), 0.56)


def card(rng: np.random.Generator) -> list[Patch]:
    """A flat card, its two sides different."""
    return prism(rectangle(0.78, 0.55), 0.02)


def wedge(rng: np.random.Generator) -> list[Patch]:
    """A right-angled ramp."""
    return prism(np.array([(-0.75, -0.4), (0.65, -0.4), (-0.75, 0.5)]), 0.45)


def bottle(rng: np.random.Generator) -> list[Patch]:
    """A surface of revolution with shoulders, neck and cap."""
    profile = [(0.0, -0.9), (0.33, -0.9), (0.38, -0.84), (0.38, 0.1), (0.36, 0.25), (0.28, 0.4), (0.17, 0.52)]
    profile += [(0.13, 0.62), (0.13, 0.72), (0.18, 0.73), (0.18, 0.93), (0.0, 0.94)]
    return revolve(subdivide_polyline(np.array(profile)), sectors=2)


def vase(rng: np.random.Generator) -> list[Patch]:
    """A surface of revolution with a belly; its print of bands does not tell how far it has turned."""
    profile = [(0.0, -0.88), (0.3, -0.88), (0.36, -0.8), (0.5, -0.55), (0.58, -0.25), (0.56, 0.05)]
    profile += [(0.44, 0.32), (0.3, 0.5), (0.26, 0.66), (0.34, 0.85), (0.32, 0.9), (0.0, 0.9)]
    return revolve(subdivide_polyline(np.array(profile)), sectors=2)


def blob(rng: np.random.Generator) -> list[Patch]:
    """A sphere with smooth bumps and dents."""
    centres = rng.normal(size=(14, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    heights = rng.choice([-0.3, 0.45], 14) * rng.uniform(0.5, 1, 14)
    patches = cube_sphere(24)
    shapes = [1 + np.exp(7 * (patch.vertices @ centres.T - 1)) @ heights for patch in patches]
    largest = max(shape.max() for shape in shapes)
    return [
        Patch(0.95 * patch.vertices * shape[:, None] / largest, patch.faces, patch.uvs)
        for patch, shape in zip(patches, shapes, strict=True)
    ]


def mug(rng: np.random.Generator) -> list[Patch]:
    """An open mug with a handle that one can look through."""
    wall = [
        (0.0, -0.62),
        (0.45, -0.62),
        (0.5, -0.57),
        (0.5, 0.6),
        (0.48, 0.62),
        (0.45, 0.6),
        (0.45, -0.5),
        (0.0, -0.52),
    ]
    body = revolve(subdivide_polyline(np.array(wall)), sectors=2)
    angle = np.linspace(-0.58, 0.58, 40) * math.pi
    curve = np.stack([0.5 + 0.32 * np.cos(angle), 0.38 * np.sin(angle), np.zeros_like(angle)], 1)
    handle = tube(curve, 0.075, np.array([0.0, 0.0, 1.0]))
    return [Patch(patch.vertices - (0.12, 0, 0), patch.faces, patch.uvs) for patch in (*body, *handle)]


PROCEDURAL: dict[str, Callable[[np.random.Generator], list[Patch]]] = {
    "box": box,
    "bottle": bottle,
    "blob": blob,
    "mug": mug,
    "card": card,
    "wedge": wedge,
    "vase": vase,
    "organic": organic,
    "assembly": assembly,
    "stick": stick,
    "knob": knob,
    "bowl": bowl,
}
"""The procedural objects by name."""


def make_procedural_solid(spec: SequenceSpec) -> Solid:
    """The procedural object of a sequence; `SequenceSpec.object` is one of `PROCEDURAL`."""
    patches = PROCEDURAL[spec.object](spec.random("shape"))
    rng = spec.random("texture")
    if spec.textured and spec.object == "vase":
        panels = [paint_bands(rng, PANEL)] * len(patches)
    elif spec.textured:
        panels = [paint_panel(rng, PANEL) for _ in patches]
    else:
        hue = rng.random()
        panels = [paint_plain(rng, PANEL, hue) for _ in patches]
    if spec.label:
        panels = stick_label(patches, panels, spec.random("label"))
    vertices, faces, uvs, texture = assemble(patches, [panel.round().astype(np.uint8) for panel in panels])
    symmetries, axis = np.eye(4)[None], None
    plain = (not spec.textured and not spec.label) or spec.print_strength == 0
    if plain and spec.object in ("box", "card"):
        symmetries = _turns([np.zeros(3), *(math.pi * np.eye(3))])
    if spec.object == "vase" or (plain and spec.object in ("bottle", "bowl")):
        axis = np.array([0.0, 1.0, 0.0])
        symmetries = _turns(np.linspace(0, 2 * math.pi, _STEPS_AROUND, endpoint=False)[:, None] * axis)
    frame = "origin in the middle of the body, y up, about one unit in radius"
    return Solid(vertices, faces, texture, uvs, None, MILLIMETRES, symmetries, axis, frame)


def _turns(rotation_vectors: list[Array] | Array) -> Array:
    """``(S, 4, 4)`` rotations about the origin."""
    transforms = np.tile(np.eye(4), (len(rotation_vectors), 1, 1))
    transforms[:, :3, :3] = Rotation.from_rotvec(np.asarray(rotation_vectors)).as_matrix()
    return transforms
