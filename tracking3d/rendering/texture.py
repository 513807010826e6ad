"""Bilinear sampling of a texture that wraps around in u.

A texture is ``(C, T, T)``. u runs to the right and wraps at 1, v runs down and is clamped; texel centres are at
``(i + 0.5) / T``.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Sample ``texture`` ``(C, H, W)`` at ``uv`` ``(P, 2)``: ``(P, C)``, differentiable in both."""
    width = texture.shape[2]
    # One column on each side makes the bilinear taps wrap; u itself may pass 1 on faces across the seam.
    wrapped = torch.cat([texture[:, :, -1:], texture, texture[:, :, :1]], 2)
    x = (uv[:, 0].remainder(1.0) * width + 1.0) / (width + 2) * 2 - 1
    grid = torch.stack([x, uv[:, 1] * 2 - 1], 1)[None, None]
    sampled = functional.grid_sample(wrapped[None], grid, padding_mode="border", align_corners=False)
    return sampled[0, :, 0].T
