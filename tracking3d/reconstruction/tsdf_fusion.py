"""All evidence of a shape in one truncated signed distance volume.

Positive inside. What matched depths say of a voxel is a weighted mean (Curless and Levoy, "A volumetric method for
building complex models from range images", 1996): near a depth its distance from it, before it that the voxel is free.
Behind it nothing is known. The mesh of the online map is one more such measurement, a weak one, decisive where nothing
else knows. Nothing reaches beyond the visual hull. Among volumes that agree about as well with that, the one with the
least total variation is taken (Zach, Pock and Bischof, "A globally optimal algorithm for robust TV-L1 range image
integration", 2007): noise and holes go, and what nobody saw is closed by a small surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.reconstruction.grid import FloatArray
from tracking3d.reconstruction.plane_sweep import DepthMap
from tracking3d.runtime.progress import report_each

FREE = 0.25
"""Weight of a depth in the free space before it: a wrong depth would otherwise carve a tunnel."""
PRIOR = 0.3
"""Weight of the mesh, in depths."""
VARIATION = 0.5
"""Weight of the total variation of distances in truncations, voxel to voxel."""
_STEEP = 0.1  # difference from voxel to voxel below which it counts with its square
_ROUNDS = 80
_STEP = 0.28  # the largest with which primal and dual steps converge in three dimensions is 1 / sqrt(12)


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
    for one in report_each("fusing depths", maps):
        P = one.view.P.astype(np.float32)
        x, y, z = P[:, :3] @ points.T + P[:, 3:]
        ahead = z > 1e-6
        depth, score = _sample_depth(one, x, y, z, ahead)
        behind = depth - z  # of the voxel to the surface: positive where it is free
        known = np.isfinite(behind) & (behind > -truncation)
        near = known & (behind < truncation)
        say = np.where(near, 1.0, FREE) * score
        total[known] -= (say * np.clip(behind, -truncation, truncation))[known]
        weight[known] += say[known]
    return total, weight


def fuse_depth(
    shape: tuple[int, int, int],
    hull: FloatArray,
    prior: FloatArray,
    total: FloatArray,
    weight: FloatArray,
    truncation: float,
    variation: float = VARIATION,
) -> FloatArray:
    """``(N,)`` signed distance of the surface in truncations, positive inside.

    Args:
        shape: Shape of the grid of N voxels.
        hull: ``(N,)`` signed distance from the visual hull.
        prior: ``(N,)`` from the mesh of the online map.
        total: ``(N,)`` and weight: ``(N,)`` from `depth_evidence`.
        truncation: Distances are cut off there.
        variation: Weight of the total variation; 0 takes the mean as it is.
    """
    sum_of_weights = torch.from_numpy(weight + np.float32(PRIOR)).reshape(shape)
    held = PRIOR * np.clip(prior / truncation, -1, 1)
    mean = torch.from_numpy((total / truncation + held).astype(np.float32)).reshape(shape) / sum_of_weights
    most = torch.from_numpy(np.clip(hull / truncation, -1, 1).astype(np.float32)).reshape(shape)
    # Primal and dual steps by turns (Chambolle and Pock, 2011), with a Huber norm of the gradient.
    distance = torch.minimum(mean, most)
    ahead, dual = distance.clone(), torch.zeros(3, *shape)
    for _ in range(_ROUNDS if variation else 0):
        for axis in range(3):
            steps = shape[axis] - 1
            dual[axis].narrow(axis, 0, steps).add_(ahead.diff(dim=axis), alpha=_STEP)
        dual /= 1 + _STEP * _STEEP / variation
        dual /= (dual.square().sum(0).sqrt_() / variation).clamp_min_(1)
        last, distance = distance, distance.clone()
        for axis in range(3):
            steps = shape[axis] - 1
            flow = dual[axis].narrow(axis, 0, steps)
            distance.narrow(axis, 0, steps).add_(flow, alpha=_STEP)
            distance.narrow(axis, 1, steps).sub_(flow, alpha=_STEP)
        distance.add_(sum_of_weights * mean, alpha=_STEP).div_(1 + _STEP * sum_of_weights)
        distance = torch.minimum(distance, most)
        ahead = 2 * distance - last
    return np.asarray(distance.numpy().ravel())


def _sample_depth(
    one: DepthMap, x: FloatArray, y: FloatArray, z: FloatArray, ahead: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """The depth and score nearest to where each point is seen; a map knows every ``stride``-th pixel."""
    stride = one.stride
    depths, scores = one.depth[::stride, ::stride], one.score[::stride, ::stride]
    last = len(depths) - 0.5
    depth, score = np.full(len(x), np.nan, np.float32), np.zeros(len(x), np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = x / z / stride, y / z / stride
        seen = ahead & (column > -0.5) & (column < last) & (row > -0.5) & (row < last)
    at = np.rint(row[seen]).astype(int), np.rint(column[seen]).astype(int)
    depth[seen], score[seen] = depths[at], scores[at]
    return depth, score
