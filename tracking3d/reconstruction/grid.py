"""A regular grid of voxels around an object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Grid:
    """Voxel centres at ``origin + spacing * (i, j, k)``, in object coordinates."""

    origin: NDArray[np.float64]  # (3,) the first centre
    spacing: float  # between centres
    shape: tuple[int, int, int]  # number of centres along x, y and z

    @classmethod
    def around(cls, points: NDArray[np.float64], cells: int, margin: float) -> Grid:
        """The grid around ``points`` ``(N, 3)``.

        Args:
            points: What it has to hold.
            cells: Along the longest side of the points' box.
            margin: Free space around that box on every side, relative to its longest side.
        """
        low, high = points.min(0), points.max(0)
        longest = float((high - low).max())
        spacing = longest / cells
        padding = margin * longest + 2 * spacing
        x, y, z = np.ceil((high - low + 2 * padding) / spacing).astype(int) + 1
        return cls(low - padding, spacing, (int(x), int(y), int(z)))

    @property
    def points(self) -> FloatArray:
        """``(X * Y * Z, 3)`` centres; z runs fastest."""
        axes = [self.origin[axis] + self.spacing * np.arange(count) for axis, count in enumerate(self.shape)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), 3).reshape(-1, 3).astype(np.float32)
