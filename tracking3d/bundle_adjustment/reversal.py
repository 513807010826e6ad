"""Depth reversal: the other explanation of the same tracks.

Seen from afar, points that turn one way and points of a shape with all depths negated that turns the other way look
the same (Necker's cube; Koenderink and van Doorn, "Affine structure from motion", 1991). Once an estimate has taken
the wrong one, nothing brings it back by small steps; but the right one is known, and perspective, turns about more
than one axis and the surface itself tell which it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracking3d.bundle_adjustment.reprojection import FloatArray

_ROBUST_TURNS = 5


@dataclass(frozen=True, eq=False)
class Reversal:
    """Depths negated about one point, the same in every view up to perspective."""

    centre: FloatArray  # (3,) in object coordinates; it stays where every view sees it
    direction: FloatArray  # (3,) unit vector in object coordinates, along which points are negated

    def points(self, points: FloatArray) -> FloatArray:
        """``(N, 3)`` points reversed."""
        depth = (points - self.centre) @ self.direction
        return points - 2 * depth[:, None] * self.direction

    def poses(self, T_cam_obj: FloatArray) -> FloatArray:
        """``(..., 4, 4)`` poses at which reversed points are seen in the same directions, but for perspective."""
        placed = T_cam_obj[..., :3, :3] @ self.centre + T_cam_obj[..., :3, 3]
        sight = placed / np.linalg.norm(placed, axis=-1, keepdims=True)
        reversed_T = T_cam_obj.copy()
        R = _reflection(sight) @ T_cam_obj[..., :3, :3] @ _reflection(self.direction)
        reversed_T[..., :3, :3] = R
        reversed_T[..., :3, 3] = placed - R @ self.centre
        return reversed_T

    def surface(self, vertices: FloatArray, before: FloatArray, after: FloatArray) -> FloatArray:
        """A surface that follows its points through their reversal.

        What was seen from the front is seen from the front still, so that the surface is not turned inside out: it is
        sheared along the direction, as much as the points say that its slant has changed.

        Args:
            vertices: ``(V, 3)``.
            before: ``(N, 3)`` points on it.
            after: ``(N, 3)`` where they have come to lie.

        Returns:
            ``(V, 3)`` vertices.
        """
        shift = (after - before) @ self.direction
        across = np.column_stack([np.ones(len(before)), self._across(before)])
        weight: FloatArray = np.ones(len(before))
        slant: FloatArray = np.zeros(4)
        for _ in range(_ROBUST_TURNS):
            slant = np.asarray(
                np.linalg.lstsq(weight[:, None] * across, weight * shift, rcond=None)[0], np.float64
            )
            left = np.abs(shift - across @ slant)
            far = left / (2 * float(np.median(left)) + 1e-12)
            weight = np.asarray(1 / np.sqrt(1 + far**2), np.float64)
        depth = np.column_stack([np.ones(len(vertices)), self._across(vertices)]) @ slant
        return vertices + depth[:, None] * self.direction

    def _across(self, points: FloatArray) -> FloatArray:
        """What is left of points without their depth."""
        offset = points - self.centre
        return offset - (offset @ self.direction)[:, None] * self.direction


def reversal_of(points: FloatArray, T: FloatArray) -> Reversal:
    """The reversal that leaves one view's pose as it is.

    Args:
        points: ``(N, 3)`` in object coordinates.
        T: ``(4, 4)`` pose of that view.
    """
    centre = points.mean(0)
    placed = T[:3, :3] @ centre + T[:3, 3]
    return Reversal(centre, T[:3, :3].T @ (placed / np.linalg.norm(placed)))


def _reflection(normal: FloatArray) -> FloatArray:
    """``(..., 3, 3)`` reflection of ``(..., 3)`` unit normals."""
    return np.asarray(np.eye(3) - 2 * normal[..., :, None] * normal[..., None, :])
