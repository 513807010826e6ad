"""How well patches agree with other views, in torch, all patches at once."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.reconstruction.meshing import FloatArray
from tracking3d.reconstruction.plane_sweep import AGREEING, LEAST_CONTRAST, RADIUS


def patch_scores(
    image: FloatArray,
    inside: FloatArray,
    K_inverse: NDArray[np.float64],
    others: FloatArray,
    P: NDArray[np.float64],
    pixels: NDArray[np.int64],
    depth: NDArray[np.float64],
    normal: NDArray[np.float64],
    offsets: NDArray[np.float64],
) -> tuple[FloatArray, FloatArray]:
    """See `tracking3d.reconstruction.plane_sweep.patch_scores`."""
    agreeing = min(AGREEING, len(others))
    side = len(image)
    count, depths = len(pixels), len(offsets)
    scores, contrast = torch.full((count, depths), -1.0), torch.zeros(count)
    middle = torch.from_numpy(pixels)
    whole = ((middle >= RADIUS) & (middle < side - RADIUS)).all(1)
    step = torch.arange(-RADIUS, RADIUS + 1)
    i, j = (one.flatten() for one in torch.meshgrid(step, step, indexing="ij"))
    rows, columns = (middle[:, :1] + i).clamp(0, side - 1), (middle[:, 1:] + j).clamp(0, side - 1)
    w = (torch.from_numpy(inside)[rows, columns] > 0.5).double()
    cover = w.sum(1, keepdim=True)
    T = torch.from_numpy(image)[rows, columns].double()
    T = (T - (w * T).sum(1, keepdim=True) / cover.clamp_min(1)) * w
    variance = T.square().sum(1)
    enough = whole & (cover[:, 0] >= 0.5 * len(i))
    contrast[enough] = (variance / cover[:, 0])[enough].sqrt().float()
    chosen = torch.nonzero(contrast >= LEAST_CONTRAST)[:, 0]
    Kinv, normals = torch.from_numpy(K_inverse), torch.from_numpy(normal)[chosen]
    ray = torch.column_stack([middle[chosen].flip(1).double(), torch.ones(len(chosen))]) @ Kinv.T
    facing = (normals * ray).sum(1, keepdim=True)
    tangents = [Kinv[:, axis] - ray * (normals @ Kinv[:, axis])[:, None] / facing for axis in (0, 1)]
    z = torch.from_numpy(depth)[chosen, None] + torch.from_numpy(offsets)  # (n, D)
    w, T, cover, variance = w[chosen, None], T[chosen, None], cover[chosen], variance[chosen, None]
    of_views = torch.full((len(others), len(chosen), depths), -1.0, dtype=torch.float64)
    for view, (other, projection) in enumerate(
        zip(torch.from_numpy(others), torch.from_numpy(P), strict=True)
    ):
        A, b = projection[:, :3], projection[:, 3]
        at = z[..., None] * (ray @ A.T)[:, None] + b  # (n, D, 3)
        u = at[..., :2] / at[..., 2:]
        sides = [z[..., None] * (tangent @ A.T)[:, None] for tangent in tangents]
        by_x, by_y = ((one[..., :2] - u * one[..., 2:]) / at[..., 2:] for one in sides)
        seen = (at[..., 2] > 1e-6) & ((u > RADIUS) & (u < side - RADIUS - 1)).all(2)
        seen &= by_x[..., 0] * by_y[..., 1] - by_y[..., 0] * by_x[..., 1] > 0.2
        places = u[..., None, :] + by_x[..., None, :] * j[:, None] + by_y[..., None, :] * i[:, None]
        values = torch.nn.functional.grid_sample(
            other.double()[None, None],
            (places.clamp(0, side - 1.001) * (2 / (side - 1)) - 1).reshape(1, len(chosen), -1, 2),
            align_corners=True,
        ).reshape(len(chosen), depths, -1)
        total, squares = (w * values).sum(2), (w * values.square()).sum(2)
        spread = squares - total.square() / cover
        score = (T * values).sum(2) / ((variance + 1e-6) * torch.maximum(spread, cover)).sqrt()
        of_views[view] = torch.where(seen, score, -1.0)
    scores[chosen] = of_views.topk(agreeing, 0).values.mean(0).float()
    return scores.numpy(), contrast.numpy()
