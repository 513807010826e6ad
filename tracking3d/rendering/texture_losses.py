"""Losses of a feature texture: against what frames show (paper eq. 1), and its own smoothness.

A Cauchy loss is ``log(1 + (r / scale)^2)`` of a residual r. Sampling, loss and gradients are one operation, so that
the Numba kernels need no tensor of the size of pixels times channels.
"""

from __future__ import annotations

import math

from torch import Tensor

from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.surface import check_shapes, sample_texture


def texture_losses(
    texture: Tensor,
    uv: Tensor,
    observed: Tensor,
    pixels: Tensor,
    scale: float,
    *,
    total_variation: bool = True,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Compare the texture with frames, and neighbouring texels with each other.

    Differentiable in ``texture`` and ``uv``. Fastest where channels lie side by side in memory: texture and frames
    in the memory format ``torch.channels_last``, see `channels_last`.

    Args:
        texture: ``(C, T, T)``.
        uv: ``(P, 2)`` texture coordinates seen at the pixels.
        observed: ``(B, C, H, W)`` features of the frames.
        pixels: ``(P,)`` int64, flat indices of pixels in ``(B, H, W)``.
        scale: Residual at which the loss is ``log 2``.
        total_variation: Whether to compute the second result.
        backend: See `tracking3d.rendering.backend`.

    Returns:
        ``(P,)`` mean Cauchy loss over the channels at each pixel, and the total variation: mean Cauchy loss between
        texels and their right neighbours, wrapped around in u, plus that between texels and those below; 0 if not
        wanted.

    Raises:
        ValueError: If a shape does not fit.
    """
    check_shapes(
        texture=(texture, "C T T"), uv=(uv, "P 2"), observed=(observed, "B C H W"), pixels=(pixels, "P")
    )
    rows = observed.permute(0, 2, 3, 1).reshape(-1, observed.shape[1])
    if use_numba(backend, texture, uv, observed):
        from tracking3d.rendering.kernels.texture_losses import TextureLosses

        plane = texture.permute(1, 2, 0)
        loss, variation = TextureLosses.apply(plane, uv, rows, pixels, scale, total_variation)
        return loss, variation
    loss = cauchy(sample_texture(texture, uv), rows.index_select(0, pixels), scale).mean(1)
    return loss, total_variation_loss(texture, scale) if total_variation else texture.new_zeros(())


def channels_last(image: Tensor) -> Tensor:
    """``(..., C, H, W)`` of the same values and shape whose channels lie side by side in memory."""
    return image.movedim(-3, -1).contiguous().movedim(-1, -3)


def cauchy(a: Tensor, b: Tensor, scale: float) -> Tensor:
    """Cauchy loss ``log(1 + ((a - b) / scale)^2)``, element by element."""
    factor = math.sqrt(2.0) / scale  # kornia's is log(1 + (a - b)^2 / 2)
    from kornia.losses import cauchy_loss  # takes a second to import, and kernels do without

    return cauchy_loss(a * factor, b * factor, reduction="none")


def total_variation_loss(texture: Tensor, scale: float) -> Tensor:
    """Mean Cauchy loss between neighbouring texels of ``(C, T, T)``; neighbours wrap around in u."""
    right = cauchy(texture, texture.roll(-1, 2), scale).mean()
    below = cauchy(texture[:, 1:], texture[:, :-1], scale).sum() / max(texture[:, 1:].numel(), 1)
    return right + below
