"""One lamp that stays put while the object turns: where it is, and how bright surfaces are under it.

All in camera axes and in linear light. Lambert's law with a constant ambient part, and Blinn's highlights
(Blinn, Models of light reflection for computer synthesized pictures, 1977).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d_bench.synthesis.spec import SequenceSpec

Array = NDArray[np.float64]

AMBIENT, DIFFUSE = 0.38, 0.72
"""Share of a colour that is seen in the shade, and what facing the lamp adds."""

SHININESS = 35.0
"""Blinn's exponent of the highlights."""

_DISTANCE, _SIZE = 7.0, 0.9  # of the lamp from the object, and its radius, in object radii


@dataclass(frozen=True, eq=False)
class Lamp:
    """A round lamp."""

    position: Array  # (3,) of its centre in camera coordinates
    size: float  # its radius
    brightness: Array  # (3,) factor on everything that is seen
    highlights: float  # strength of the highlights

    def points(self, count: int) -> Array:
        """``(count, 3)`` points all over the lamp's disc; the first is its centre if there is one only."""
        if count == 1:
            return self.position[None]
        # Vogel, A better way to construct the sunflower head, 1979.
        k = np.arange(count)
        angle = math.pi * (3 - math.sqrt(5)) * k
        offsets = (
            self.size * np.sqrt((k + 0.5) / count)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        )
        away = self.position / np.linalg.norm(self.position)
        side = np.cross(away, [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        points: Array = self.position + offsets @ np.stack([side, np.cross(away, side)])
        return points


def lamp_at(spec: SequenceSpec, frame: int, centre: Array, radius: float) -> Lamp:
    """The lamp of a frame.

    Args:
        spec: Under `Disturbances.light` the lamp swings around the object and changes brightness and colour; in
            frame 0 it does not differ.
        frame: Index.
        centre: ``(3,)`` where the object is in frame 0.
        radius: Radius of the object.
    """
    rng = spec.random("light")
    strength = spec.disturbances.light
    period, side = rng.uniform(25, 40), rng.choice([-1.0, 1.0])
    axis = rng.normal(size=3) * (0.5, 1.0, 0.5)
    tint = rng.uniform(-0.12, 0.12, 3)
    swing = strength * math.sin(2 * math.pi * frame / period)
    fade = 0.5 * strength * side * math.sin(2 * math.pi * frame / (0.7 * period))
    swung = Rotation.from_rotvec(math.radians(75) * swing * axis / np.linalg.norm(axis))
    turned = swung.apply(np.array(spec.lamp))
    position = centre + _DISTANCE * radius * turned / np.linalg.norm(turned)
    return Lamp(position, _SIZE * radius, np.exp(fade + swing * tint), spec.disturbances.highlights)


def shade(
    albedo: Array, points: Array, normals: Array, lit: NDArray[np.bool_] | Array, lamp: Lamp, source: Array
) -> Array:
    """Light ``(N, 3)`` that surface points send to the camera.

    Args:
        albedo: ``(N, 3)`` linear, in [0, 1].
        points: ``(N, 3)``.
        normals: ``(N, 3)`` unit, towards the camera.
        lit: ``(N,)`` whether ``source`` is seen from there, or how much of the lamp.
        lamp: The lamp.
        source: ``(3,)`` point of the lamp that shines.
    """
    towards = source - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cosine = np.einsum("ij,ij->i", normals, towards).clip(0) * lit
    light = albedo * (AMBIENT + DIFFUSE * cosine)[:, None]
    if lamp.highlights > 0:
        halfway = towards - points / np.linalg.norm(points, axis=1, keepdims=True)
        halfway /= np.linalg.norm(halfway, axis=1, keepdims=True).clip(1e-12)
        glint = np.einsum("ij,ij->i", normals, halfway).clip(0) ** SHININESS * (cosine > 0)
        light = light + (0.9 * lamp.highlights * glint)[:, None]
    return light * lamp.brightness
