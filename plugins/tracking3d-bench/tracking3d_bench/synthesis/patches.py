"""Pieces of textured surface, and their assembly to one solid with one texture.

A patch is a triangle mesh whose texture coordinates span the unit square; each gets a panel of the texture to
itself. Solids may be unions of overlapping patches: rays meet the outermost first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Patch:
    """A piece of surface."""

    vertices: Array  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3) int64, counter-clockwise seen from outside
    uvs: Array  # (V, 2) in [0, 1]


def grid(points: Array) -> Patch:
    """A rectangular net of points ``(rows, columns, 3)``.

    Outside is where rows run downwards if columns run to the right.
    """
    rows, columns = points.shape[:2]
    v, u = np.meshgrid(np.linspace(1, 0, rows), np.linspace(0, 1, columns), indexing="ij")
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return Patch(points.reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2))


def polygon(corners: Array) -> Patch:
    """A flat convex polygon ``(C, 3)``, counter-clockwise seen from outside."""
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    x = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
    y = np.cross(normal, x) / np.linalg.norm(normal)
    flat = (corners - corners[0]) @ np.stack([x, y], 1)
    flat -= flat.min(0)
    fan = np.array([(0, k, k + 1) for k in range(1, len(corners) - 1)])
    return Patch(corners, fan, flat / flat.max())


def prism(outline: Array, half_depth: float) -> list[Patch]:
    """A convex outline ``(C, 2)``, counter-clockwise, between z = -half_depth and half_depth."""
    front = np.column_stack([outline, np.full(len(outline), half_depth)])
    back = front * (1, 1, -1)
    following = np.roll(np.arange(len(outline)), -1)
    sides = [
        polygon(np.stack([back[k], back[n], front[n], front[k]])) for k, n in enumerate(following.tolist())
    ]
    return [polygon(front), polygon(back[::-1]), *sides]


def revolve(profile: Array, sectors: int, steps: int = 96) -> list[Patch]:
    """A surface of revolution about the y axis.

    Args:
        profile: ``(M, 2)`` radius and y; outside is on the right hand of one who walks along it with y up.
        sectors: Patches around the axis.
        steps: Divisions of the full circle.
    """
    patches = []
    for sector in range(sectors):
        angle = np.linspace(0, 2 * math.pi / sectors, steps // sectors + 1) + 2 * math.pi * sector / sectors
        ring = np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], 1)
        points = profile[:, None, :1] * ring + profile[:, None, 1:] * np.array([0.0, 1.0, 0.0])
        patches.append(grid(points[:, ::-1]))
    return patches


def rectangle(x: float, y: float) -> Array:
    """The outline ``(4, 2)`` of a rectangle of these half sides around the origin."""
    return np.array([(-x, -y), (x, -y), (x, y), (-x, y)])


def subdivide_polyline(profile: Array, step: float = 0.04) -> Array:
    """The same polyline with points at most ``step`` apart."""
    pieces = []
    for start, end in pairwise(profile):
        count = max(math.ceil(np.linalg.norm(end - start) / step), 1)
        pieces.append(start + np.arange(count)[:, None] / count * (end - start))
    return np.concatenate([*pieces, profile[-1:]])


def tube(
    centres: Array, radius: float | Array, side: Array, steps: int = 20, sections: int = 1
) -> list[Patch]:
    """A round tube along a curve.

    Args:
        centres: ``(M, 3)`` along the curve, in a plane.
        radius: Radius of the whole tube, or ``(M, 1)``; where it ends at 0 the tube is closed.
        side: ``(3,)`` unit normal of the curve's plane.
        steps: Divisions around.
        sections: Patches along the curve.
    """
    along = np.gradient(centres, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    out = np.cross(side, along)
    angle = np.linspace(0, 2 * math.pi, steps + 1)[:, None, None]
    points = centres + radius * (np.cos(angle) * out + np.sin(angle) * side)
    ends = np.linspace(0, len(centres) - 1, sections + 1).round().astype(int).tolist()
    return [grid(points[:, start : end + 1]) for start, end in pairwise(ends)]


def cube_sphere(steps: int) -> list[Patch]:
    """The unit sphere as six patches of nearly equal cells."""
    t = np.tan(np.linspace(-math.pi / 4, math.pi / 4, steps + 1))
    right, down = np.meshgrid(t, t)
    patches = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            a, b, c = np.roll(np.eye(3), axis, 1)
            points = sign * a + right[..., None] * sign * b - down[..., None] * c
            # Rounded, so that neighbours share their edge exactly.
            patches.append(grid(np.round(points / np.linalg.norm(points, axis=2, keepdims=True), 9)))
    return patches


def assemble(
    patches: Sequence[Patch], panels: Sequence[NDArray[np.uint8]]
) -> tuple[Array, NDArray[np.int64], Array, NDArray[np.uint8]]:
    """Join patches to one mesh, and their panels ``(S, S, 3)``, all of one size, to one texture.

    Returns:
        Vertices ``(V, 3)``; faces ``(F, 3)``; texture coordinates ``(V, 2)`` with v upwards, half a texel inside
        their panel so that neighbours never mix; texture ``(H, W, 3)`` uint8.
    """
    across = math.ceil(math.sqrt(len(patches)))
    down = math.ceil(len(patches) / across)
    side = panels[0].shape[0]
    texture = np.zeros((down * side, across * side, 3), np.uint8)
    vertices, faces, uvs, count = [], [], [], 0
    for k, (patch, panel) in enumerate(zip(patches, panels, strict=True)):
        row, column = divmod(k, across)
        texture[row * side : (row + 1) * side, column * side : (column + 1) * side] = panel
        inside = (0.5 + patch.uvs * (side - 1)) / side
        uvs.append((inside + np.array([column, down - 1 - row])) / (across, down))
        vertices.append(patch.vertices)
        faces.append(patch.faces + count)
        count += len(patch.vertices)
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(uvs), texture
