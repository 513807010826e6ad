"""The visual hull, robust against a share of wrong masks.

A point is outside where enough views put it there. In each view its distance from the mask's outline is taken into
space by the point's depth; of these signed distances, negative outside, the hull has not the least one but the one at
a low rank: a few wrong masks, or a hand that passes, carve nothing. What is left is about the signed distance from the
hull, and smooth, so that a surface lies between the voxels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tracking3d.reconstruction.grid import FloatArray
from tracking3d.reconstruction.shape_views import ShapeView

SHARE = 0.05
"""Of the views that see a point, those that may be wrong."""
LEAST = 1
"""And so many at least."""


def robust_hull(
    points: FloatArray,
    views: Sequence[ShapeView],
    far: float,
    share: float = SHARE,
    least: int = LEAST,
) -> tuple[FloatArray, FloatArray]:
    """Signed distance from the hull, positive inside, and by how many views it is known.

    Args:
        points: ``(N, 3)`` in object coordinates.
        views: The frames.
        far: Distances are cut off there.
        share: Of the views that may be wrong.
        least: Number of views that may be wrong however few there are.

    Returns:
        ``(N,)`` and ``(N,)``. A point that no view sees is inside.
    """
    P = np.stack([view.P for view in views])
    focal = np.array([view.K[0, 0] for view in views])
    inside = np.stack([view.depth_inside for view in views])
    within = np.stack([view.within for view in views])
    from tracking3d.reconstruction.kernels.hull import robust_hull as compiled

    hull, seen = np.empty(len(points), np.float32), np.empty(len(points), np.float32)
    compiled(
        np.ascontiguousarray(points, np.float32), P, focal, inside, within, share, least, far, hull, seen
    )
    return hull, seen
