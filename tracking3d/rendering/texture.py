"""Bilinear sampling of a texture that wraps around in u.

A texture is ``(C, T, T)``. u runs to the right and wraps at 1, v runs down and is clamped; texel centres are at
``(i + 0.5) / T``.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Sample ``texture`` ``(C, H, W)`` at ``uv`` ``(P, 2)``: ``(P, C)``, differentiable in both.

    A place that is not finite gives NaN.
    """
    # grid_sample takes such a place for one on the border, and its gradient reads beyond the texture there.
    sound = uv.isfinite().all(1)
    uv = torch.where(sound[:, None], uv, 0.5)
    width = texture.shape[2]
    # One column on each side makes the bilinear taps wrap; u itself may pass 1 on faces across the seam.
    wrapped = torch.cat([texture[:, :, -1:], texture, texture[:, :, :1]], 2)
    x = (uv[:, 0].remainder(1.0) * width + 1.0) / (width + 2) * 2 - 1
    grid = torch.stack([x, uv[:, 1] * 2 - 1], 1)[None, None]
    sampled = functional.grid_sample(wrapped[None], grid, padding_mode="border", align_corners=False)
    return torch.where(sound, sampled[0, :, 0], torch.nan).T


def bilinear_taps(texture: Tensor, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same samples ``(P, C)``, and their derivatives by u and by v ``(P, C)``; not differentiable twice."""
    height, width = texture.shape[1:]
    x = uv[:, 0].remainder(1.0) * width - 0.5
    y = uv[:, 1] * height - 0.5
    free = (y > 0) & (y < height - 1)
    y = y.clamp(0, height - 1)
    left, top = x.floor(), y.floor()
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    columns = [(left.long() + step).remainder(width) for step in (0, 1)]
    rows = [(top.long() + step).clamp_max(height - 1) for step in (0, 1)]
    flat = texture.flatten(1)
    (t00, t01), (t10, t11) = (
        [flat.index_select(1, row * width + column).T for column in columns] for row in rows
    )
    upper, lower = t00 + fx * (t01 - t00), t10 + fx * (t11 - t10)
    by_x = (t01 - t00) + fy * ((t11 - t10) - (t01 - t00))
    by_v = torch.where(free[:, None], (lower - upper) * height, 0.0)
    return upper + fy * (lower - upper), by_x * width, by_v
