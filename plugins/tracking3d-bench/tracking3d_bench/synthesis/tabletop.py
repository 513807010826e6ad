"""The table that an object is taken from, and the wall behind it.

Both are planes, so that a camera that shakes sees them through a homography each: their colours are worked out once,
in a picture that is a little wider and finer than the frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera
from tracking3d_bench.synthesis.motions import Path
from tracking3d_bench.synthesis.room import paint_plane
from tracking3d_bench.synthesis.solid import Solid
from tracking3d_bench.synthesis.spec import SequenceSpec
from tracking3d_bench.synthesis.texture_lookup import filter_texture

Array = NDArray[np.float64]

_FINER, _MARGIN = (
    1.25,
    0.1,
)  # of the picture: pixels per pixel, and what it shows beyond each side, of the height
_TABLE, _WALL = (1280, 10.0), (768, 16.0)  # texels a side, and length of a side in object radii
_ROWS_AT_ONCE = 128


@dataclass(frozen=True, eq=False)
class Plane:
    """A painted plane, where the object stood in frame 0."""

    origin: Array  # (3,) point on it
    axes: Array  # (3, 3): two directions on it and its normal towards the camera, as columns
    picture: NDArray[np.float32]  # (h, w, 3) linear colours of it, as a camera saw them
    to_picture: Array  # (3, 3) homography from coordinates along the axes to pixels of the picture

    def to_pixels(self, K: Array, T_cam_rest: Array) -> Array:
        """The homography ``(3, 3)`` from coordinates along the axes to pixels of a camera."""
        R, t = T_cam_rest[:3, :3], T_cam_rest[:3, 3]
        H: Array = K @ np.column_stack([R @ self.axes[:, 0], R @ self.axes[:, 1], R @ self.origin + t])
        return H


@dataclass(frozen=True, eq=False)
class Tabletop:
    """The surroundings of an object that is taken from a table."""

    table: Plane  # Level, below the object
    wall: Plane  # Upright, behind the table; it meets it at its own origin, along its first axis


def build_tabletop(spec: SequenceSpec, solid: Solid, path: Path, camera: Camera) -> Tabletop:
    """Table and wall of a sequence of the motion ``pick_up``."""
    rng = spec.random("room")
    T = path.T_cam_rest(np.zeros(1))[0]
    up = np.array([0.0, 1.0, 0.0])
    back = T[2, :3] * (1, 0, 1)
    back /= np.linalg.norm(back)
    right = np.cross(back, up)
    below = np.array([0.0, solid.vertices[:, 1].min(), 0.0])
    behind = below + solid.radius * rng.uniform(3.5, 8) * back
    table = _plane(rng, below, np.stack([right, back, up], 1), _TABLE, solid.radius, T, camera)
    wall = _plane(rng, behind, np.stack([right, up, -back], 1), _WALL, solid.radius, T, camera)
    return Tabletop(table, wall)


def _plane(
    rng: np.random.Generator,
    origin: Array,
    axes: Array,
    resolution: tuple[int, float],
    radius: float,
    T_cam_rest: Array,
    camera: Camera,
) -> Plane:
    """Paint a plane, and see it as the camera of frame 0 does."""
    texels, side = resolution
    levels = paint_plane(rng, texels, (0.15, 0.9))
    margin = round(_FINER * _MARGIN * camera.height)
    width, height = (round(_FINER * size) + 2 * margin for size in (camera.width, camera.height))
    finer = np.array([[_FINER, 0, margin], [0, _FINER, margin], [0, 0, 1.0]])
    blank = np.zeros((height, width, 3), np.float32)
    plane = Plane(origin, axes, blank, np.eye(3))
    to_picture = finer @ plane.to_pixels(camera.K, T_cam_rest)
    back = np.linalg.inv(to_picture)
    density = texels / (side * radius)
    for start in range(0, height, _ROWS_AT_ONCE):
        rows, columns = np.mgrid[start : min(start + _ROWS_AT_ONCE, height), :width]
        x, y, w = back @ np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)])
        w = np.where(np.abs(w) > 1e-9, w, 1e-9)
        place = np.stack([x, y], 1) / w[:, None]
        share = place / (side * radius) + 0.5
        mirrored = 1 - np.abs(share % 2 - 1)  # beyond its sides the texture goes on without a seam
        # The area of a pixel on the plane, of which a texel should have the size.
        area = np.abs(np.linalg.det(back)) / np.abs(w) ** 3
        colours = filter_texture(levels, mirrored, density * np.sqrt(area))
        blank[start : start + len(rows)] = colours.reshape(*rows.shape, 3)
    return Plane(origin, axes, blank, to_picture)
