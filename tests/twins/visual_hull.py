"""The robust visual hull in torch, all points of a view at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from tracking3d.reconstruction.meshing import FloatArray
from tracking3d.scene.view import ObjectView


def robust_hull(
    points: FloatArray, views: Sequence[ObjectView], far: float, share: float, least: int
) -> tuple[FloatArray, FloatArray]:
    """See `tracking3d.reconstruction.shape.carve_hull`."""
    P = np.stack([view.P for view in views])
    focal = np.array([view.K[0, 0] for view in views])
    inside = np.stack([view.signed_distance for view in views])
    within = np.stack([view.frame_edges for view in views])
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


def vary_little(
    mean: FloatArray,
    weight: FloatArray,
    most: FloatArray,
    steep: float,
    variation: float,
    rounds: int,
    distance: FloatArray,
) -> FloatArray:
    """See `tracking3d.reconstruction.kernels.visual_hull.vary_little`; the result is returned."""
    mean, weight, most, distance = (torch.from_numpy(part) for part in (mean, weight, most, distance))
    step, shape = 0.28, distance.shape
    ahead, dual = distance.clone(), torch.zeros(3, *shape)
    for _ in range(rounds):
        for axis in range(3):
            dual[axis].narrow(axis, 0, shape[axis] - 1).add_(ahead.diff(dim=axis), alpha=step)
        dual /= 1 + step * steep / variation
        dual /= (dual.square().sum(0).sqrt() / variation).clamp_min(1)
        last, distance = distance, distance.clone()
        for axis in range(3):
            flow = dual[axis].narrow(axis, 0, shape[axis] - 1)
            distance.narrow(axis, 0, shape[axis] - 1).add_(flow, alpha=step)
            distance.narrow(axis, 1, shape[axis] - 1).sub_(flow, alpha=step)
        distance = torch.minimum((distance + step * weight * mean) / (1 + step * weight), most)
        ahead = 2 * distance - last
    return distance.numpy()
