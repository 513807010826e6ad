"""All evidence of a shape in one truncated signed distance volume.

Positive inside. What matched depths say of a voxel is a weighted mean (Curless and Levoy, "A volumetric method for
building complex models from range images", 1996): near a depth its distance from it, before it that the voxel is free.
Behind it nothing is known. The mesh of the online map is one more such witness, a weak one, which decides where nobody
else knows. Nothing reaches beyond the visual hull.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tracking3d.reconstruction.depth_maps import DepthMap
from tracking3d.reconstruction.grid import FloatArray

FREE = 0.25
"""Weight of a depth in the free space before it: a wrong depth would otherwise carve a tunnel."""
PRIOR = 1.0
"""Weight of the mesh, in depths."""


def depth_evidence(
    points: FloatArray, maps: Sequence[DepthMap], truncation: float
) -> tuple[FloatArray, FloatArray]:
    """What depth maps say.

    Args:
        points: ``(N, 3)`` in object coordinates.
        maps: The depths.
        truncation: Distances are cut off there.

    Returns:
        ``(N,)`` weighted sum of signed distances, and ``(N,)`` of weights.
    """
    total, weight = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for one in maps:
        P = one.view.P.astype(np.float32)
        x, y, z = P[:, :3] @ points.T + P[:, 3:]
        ahead = z > 1e-6
        depth, score = _sampled(one, x, y, z, ahead)
        behind = depth - z  # of the voxel to the surface: positive where it is free
        known = np.isfinite(behind) & (behind > -truncation)
        near = known & (behind < truncation)
        say = np.where(near, 1.0, FREE) * score
        total[known] -= (say * np.clip(behind, -truncation, truncation))[known]
        weight[known] += say[known]
    return total, weight


def fused(
    hull: FloatArray, prior: FloatArray, total: FloatArray, weight: FloatArray, truncation: float
) -> FloatArray:
    """``(N,)`` signed distance of the surface, positive inside.

    Args:
        hull: ``(N,)`` signed distance from the visual hull.
        prior: ``(N,)`` from the mesh of the online map.
        total: ``(N,)`` and weight: ``(N,)`` from `depth_evidence`.
        truncation: Distances are cut off there.
    """
    held = PRIOR * np.clip(prior, -truncation, truncation)
    mean = (total + held) / (weight + PRIOR)
    return np.minimum(mean, np.clip(hull, -truncation, truncation)).astype(np.float32)


def _sampled(
    one: DepthMap, x: FloatArray, y: FloatArray, z: FloatArray, ahead: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    side = len(one.depth)
    depth, score = np.full(len(x), np.nan, np.float32), np.zeros(len(x), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = x / z, y / z
        seen = ahead & (column > -0.5) & (column < side - 0.5) & (row > -0.5) & (row < side - 0.5)
    at = np.rint(row[seen]).astype(int), np.rint(column[seen]).astype(int)
    depth[seen], score[seen] = one.depth[at], one.score[at]
    return depth, score
