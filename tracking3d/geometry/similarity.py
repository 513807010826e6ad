"""Similarities: rotation, scale and translation between two objects' coordinates.

::

    x_first = scale R x_second + translation
    x_cam_first = scale x_cam_second
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Similarity:
    """From the second object's coordinates to the first's.

    One camera cannot tell size from distance, so that the cameras' distances go with the scale.
    """

    R: Array  # (3, 3) rotation
    scale: float  # length of the second's unit in that of the first
    translation: Array  # (3,) in the first's unit

    @classmethod
    def identity(cls) -> Similarity:
        """No change."""
        return cls(np.eye(3), 1.0, np.zeros(3))

    def points(self, x_second: Array) -> Array:
        """Points ``(N, 3)`` of the second object in coordinates of the first."""
        return self.scale * x_second @ self.R.T + self.translation

    def poses(self, T_cam_second: Array) -> Array:
        """Poses ``(N, 4, 4)`` of the second object as poses of the first."""
        poses = np.tile(np.eye(4), (len(T_cam_second), 1, 1))
        poses[:, :3, :3] = T_cam_second[:, :3, :3] @ self.R.T
        poses[:, :3, 3] = self.scale * T_cam_second[:, :3, 3] - poses[:, :3, :3] @ self.translation
        return poses

    @property
    def inverse(self) -> Similarity:
        """From the first object's coordinates to the second's."""
        return Similarity(self.R.T, 1 / self.scale, -self.translation @ self.R / self.scale)

    def after(self, other: Similarity) -> Similarity:
        """First ``other``, then this one."""
        moved = self.points(other.translation[None])[0]
        return Similarity(self.R @ other.R, self.scale * other.scale, moved)
