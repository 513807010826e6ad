"""The visual hull, the distance from a mesh, and total variation, by voxels; see `tracking3d.reconstruction.shape`."""

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


@kernel("void(float64[:,:,::1], float64, float32[:,:,::1])")
def surface_distance(corners: NDArray[Any], far: float, distance: NDArray[Any]) -> None:
    """Fill ``distance`` (X, Y, Z) with that from the triangles (F, 3, 3), in voxels and cut off at ``far``.

    The closest point of a triangle: Ericson, "Real-Time Collision Detection", 2005, section 5.1.5.
    """
    distance[:] = far * far
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for f in range(len(corners)):
        a, ab, ac = corners[f, 0], corners[f, 1] - corners[f, 0], corners[f, 2] - corners[f, 0]
        for k in range(3):
            low[k] = max(np.ceil(corners[f, :, k].min() - far), 0)
            high[k] = min(np.floor(corners[f, :, k].max() + far) + 1, distance.shape[k])
        bb, bc, cc = (ab * ab).sum(), (ab * ac).sum(), (ac * ac).sum()
        area = max(bb * cc - bc * bc, 1e-300)
        for i in range(low[0], high[0]):
            for j in range(low[1], high[1]):
                for k in range(low[2], high[2]):
                    x, y, z = i - a[0], j - a[1], k - a[2]
                    p, q = x * ab[0] + y * ab[1] + z * ab[2], x * ac[0] + y * ac[1] + z * ac[2]
                    square = x * x + y * y + z * z
                    s, t = (cc * p - bc * q) / area, (bb * q - bc * p) / area
                    if s >= 0 and t >= 0 and s + t <= 1:
                        found = square - s * p - t * q
                    else:  # the nearest of the three edges
                        s, t = min(max(p / max(bb, 1e-300), 0), 1), min(max(q / max(cc, 1e-300), 0), 1)
                        found = min(square - s * (2 * p - s * bb), square - t * (2 * q - t * cc))
                        edge, along = bb - 2 * bc + cc, bb - bc - p + q
                        s = min(max(along / max(edge, 1e-300), 0), 1)
                        found = min(found, square - 2 * p + bb - s * (2 * along - s * edge))
                    distance[i, j, k] = min(distance[i, j, k], max(found, 0))
    distance[:] = np.sqrt(distance)


@kernel(
    "void(float32[:,:,::1], float32[:,:,::1], float32[:,:,::1], float32, float32, int64, float32[:,:,::1])"
)
def vary_little(
    mean: NDArray[Any], weight: NDArray[Any], most: NDArray[Any], steep: float, variation: float, rounds: int,
    distance: NDArray[Any],
) -> None:  # fmt: skip
    """Smooth ``distance`` (X, Y, Z): near ``mean`` by ``weight``, at most ``most``, with little total variation.

    Primal and dual steps by turns (Chambolle and Pock, 2011); below ``steep`` the square of the gradient counts.
    """
    step, one = np.float32(0.28), np.float32(1)  # both converge in three dimensions up to 1 / sqrt(12)
    X, Y, Z = distance.shape
    # One place more on every side, where the gradient is 0.
    ahead, dual = np.zeros((X + 1, Y + 1, Z + 1), np.float32), np.zeros((3, X + 1, Y + 1, Z + 1), np.float32)
    ahead[:X, :Y, :Z] = distance
    shrink = one / (one + step * steep / variation)
    for _ in range(rounds):
        for i in range(X):
            for j in range(Y):
                here, down, right = ahead[i, j], ahead[i + 1, j], ahead[i, j + 1]
                here[Z] = here[Z - 1]
                x, y, z = dual[:, i + 1, j + 1]
                by_x, by_y = np.float32(i + 1 < X) * step, np.float32(j + 1 < Y) * step
                for k in range(Z):
                    at_x = (x[k + 1] + by_x * (down[k] - here[k])) * shrink
                    at_y = (y[k + 1] + by_y * (right[k] - here[k])) * shrink
                    at_z = (z[k + 1] + step * (here[k + 1] - here[k])) * shrink
                    within = variation / max(np.sqrt(at_x * at_x + at_y * at_y + at_z * at_z), variation)
                    x[k + 1], y[k + 1], z[k + 1] = at_x * within, at_y * within, at_z * within
        for i in range(X):
            for j in range(Y):
                x, y, z = dual[:, i + 1, j + 1]
                before, left = dual[0, i, j + 1], dual[1, i + 1, j]
                for k in range(Z):
                    last, held = distance[i, j, k], weight[i, j, k] * step
                    flow = x[k + 1] + y[k + 1] + z[k + 1] - before[k + 1] - left[k + 1] - z[k]
                    found = min((last + step * flow + held * mean[i, j, k]) / (one + held), most[i, j, k])
                    distance[i, j, k], ahead[i, j, k] = found, found + found - last
