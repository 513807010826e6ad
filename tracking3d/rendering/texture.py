"""Bilinear sampling of a texture that wraps around in u, and its gradient.

A texture is ``(T, T, C)``, channels last: one row of the table is one texel. u runs to the right and wraps at
1, v runs down and is clamped; texel centres are at ``(i + 0.5) / T``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def bilinear_taps(uv: Tensor, height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four texels around each point.

    Args:
        uv: ``(P, 2)``.
        height, width: Texture size.

    Returns:
        ``(P, 4)`` flat texel indices, their ``(P, 4)`` weights, and the ``(P,)`` fractions along x and y.
    """
    x = uv[:, 0] * width - 0.5
    y = (uv[:, 1] * height - 0.5).clamp(0, height - 1)
    left, top = x.floor(), y.floor().clamp_max(height - 2)
    fx, fy = x - left, y - top
    column = left.long().remainder(width)
    following = torch.where(column == width - 1, 0, column + 1)
    row = top.long() * width
    texel = torch.stack([row + column, row + following, row + width + column, row + width + following], 1)
    gx, gy = 1 - fx, 1 - fy
    return texel, torch.stack([gx * gy, fx * gy, gx * fy, fx * fy], 1), fx, fy


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Sample ``texture`` ``(H, W, C)`` at ``uv`` ``(P, 2)``: ``(P, C)``, differentiable in both."""
    result: Tensor = _SampleTexture.apply(texture, uv)
    return result


class _SampleTexture(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, texture: Tensor, uv: Tensor) -> Tensor:
        height, width, channels = texture.shape
        texel, weight, fx, fy = bilinear_taps(uv, height, width)
        taps = texture.reshape(-1, channels)[texel]  # (P, 4, C)
        ctx.save_for_backward(texel, weight, fx, fy, taps)
        ctx.texture_shape = texture.shape
        return torch.bmm(weight[:, None], taps)[:, 0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None]:  # type: ignore[override]
        texel, weight, fx, fy, taps = ctx.saved_tensors
        height, width, channels = ctx.texture_shape
        grad_texture = grad_uv = None
        if ctx.needs_input_grad[0]:
            grad_texture = grad.new_zeros(height * width, channels)
            spread = (weight[..., None] * grad[:, None]).reshape(-1, channels)
            grad_texture.index_add_(0, texel.reshape(-1), spread)
            grad_texture = grad_texture.reshape(ctx.texture_shape)
        if ctx.needs_input_grad[1]:
            a, b, c, d = torch.bmm(taps, grad[..., None])[..., 0].unbind(1)
            along_x = (b - a) * (1 - fy) + (d - c) * fy
            along_y = (c - a) * (1 - fx) + (d - b) * fx
            grad_uv = torch.stack([along_x * width, along_y * height], 1)
        return grad_texture, grad_uv
