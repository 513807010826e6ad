"""The visual hull, robust against a share of wrong masks.

A point is outside where enough views put it there. In each view its distance from the mask's outline is taken into
space by the point's depth; of these signed distances, negative outside, the hull has not the least one but the one at
a low rank: a few wrong masks, or a hand that passes, carve nothing. What is left is about the signed distance from the
hull, and smooth, so that a surface lies between the voxels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.reconstruction.grid import FloatArray
from tracking3d.reconstruction.shape_views import ShapeView
from tracking3d.rendering.backend import use_numba

SHARE = 0.05
"""Of the views that see a point, those that may be wrong."""
LEAST = 1
"""And so many at least."""


def carve_hull(
    points: FloatArray,
    views: Sequence[ShapeView],
    far: float,
    share: float = SHARE,
    least: int = LEAST,
    backend: str = "auto",
) -> tuple[FloatArray, FloatArray]:
    """Signed distance from the hull, positive inside, and by how many views it is known.

    Args:
        points: ``(N, 3)`` in object coordinates.
        views: The frames.
        far: Distances are cut off there.
        share: Of the views that may be wrong.
        least: Number of views that may be wrong however few there are.
        backend: See `tracking3d.rendering.backend`.

    Returns:
        ``(N,)`` and ``(N,)``. A point that no view sees is inside.
    """
    P = np.stack([view.P for view in views])
    focal = np.array([view.K[0, 0] for view in views])
    inside = np.stack([view.depth_inside for view in views])
    within = np.stack([view.within for view in views])
    if not use_numba(backend, torch.empty(0, dtype=torch.float32)):
        return _together(points, P, focal, inside, within, share, least, far)
    from tracking3d.reconstruction.kernels.visual_hull import robust_hull as compiled

    hull, seen = np.empty(len(points), np.float32), np.empty(len(points), np.float32)
    compiled(
        np.ascontiguousarray(points, np.float32), P, focal, inside, within, share, least, far, hull, seen
    )
    return hull, seen


def _together(
    points: FloatArray,
    P: NDArray[np.float64],
    focal: NDArray[np.float64],
    inside: FloatArray,
    within: FloatArray,
    share: float,
    least: int,
    far: float,
) -> tuple[FloatArray, FloatArray]:
    """The same as the kernel in torch, all points of a view at once."""
    side = inside.shape[1]
    values = torch.full((len(P), len(points)), torch.inf, dtype=torch.float64)
    at = torch.from_numpy(np.asarray(points, np.float64))
    for v, projection in enumerate(torch.from_numpy(P)):
        x, y, depth = (at @ projection[:, :3].T + projection[:, 3]).unbind(1)
        x, y = x / depth, y / depth
        left, right, top, bottom = (float(edge) for edge in within[v])
        known = (depth > 1e-6) & (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
        window = known & (x >= 0) & (x < side - 1) & (y >= 0) & (y < side - 1)
        grid = torch.stack([x, y], 1)[window] * (2 / (side - 1)) - 1
        sampled = torch.nn.functional.grid_sample(
            torch.from_numpy(inside[v]).double()[None, None], grid[None, None], align_corners=True
        ).flatten()
        values[v, known] = -far
        values[v, window] = (sampled * depth[window] / focal[v]).clamp(-far, far)
    ordered = values.sort(0).values
    seen = values.isfinite().sum(0)
    rank = torch.minimum((share * seen).long() + least, seen - 1).clamp_min(0)
    hull = ordered.gather(0, rank[None])[0].clamp_max(far)
    return hull.float().numpy(), seen.float().numpy()
