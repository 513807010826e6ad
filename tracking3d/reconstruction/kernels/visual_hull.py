"""The robust visual hull, voxel by voxel; `tracking3d.reconstruction.shape` says what is computed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import kernel


@kernel(
    "void(float32[:,::1], float64[:,:,::1], float64[::1], float32[:,:,::1], float32[:,::1], float64, int64, float64,"
    " float32[::1], float32[::1])"
)
def robust_hull(
    points: NDArray[Any],
    P: NDArray[Any],
    focal: NDArray[Any],
    inside: NDArray[Any],
    within: NDArray[Any],
    share: float,
    least: int,
    far: float,
    hull: NDArray[Any],
    seen: NDArray[Any],
) -> None:
    """Fill ``hull`` (N,) with signed distances and ``seen`` (N,) with the number of views that know a point."""
    views, side = len(P), inside.shape[1]
    most = int(share * views) + least + 1
    smallest = np.empty(most)
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        kept, count = 0, 0
        for v in range(views):
            depth = P[v, 2, 0] * x + P[v, 2, 1] * y + P[v, 2, 2] * z + P[v, 2, 3]
            if depth <= 1e-6:
                continue
            column = (P[v, 0, 0] * x + P[v, 0, 1] * y + P[v, 0, 2] * z + P[v, 0, 3]) / depth
            row = (P[v, 1, 0] * x + P[v, 1, 1] * y + P[v, 1, 2] * z + P[v, 1, 3]) / depth
            if not (within[v, 0] <= column <= within[v, 1] and within[v, 2] <= row <= within[v, 3]):
                continue
            count += 1
            if 0 <= column < side - 1 and 0 <= row < side - 1:
                i, j = int(row), int(column)
                down, right = row - i, column - j
                upper = inside[v, i, j] * (1 - right) + inside[v, i, j + 1] * right
                lower = inside[v, i + 1, j] * (1 - right) + inside[v, i + 1, j + 1] * right
                value = (upper * (1 - down) + lower * down) * depth / focal[v]
            else:
                value = -far
            value = min(max(value, -far), far)
            if kept < most:
                place = kept
                kept += 1
            elif value < smallest[most - 1]:
                place = most - 1
            else:
                continue
            while place > 0 and smallest[place - 1] > value:
                smallest[place] = smallest[place - 1]
                place -= 1
            smallest[place] = value
        seen[n] = count
        rank = min(int(share * count) + least, count - 1)
        hull[n] = smallest[rank] if count > 0 else far
