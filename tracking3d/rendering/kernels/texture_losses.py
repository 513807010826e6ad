"""Kernels of `tracking3d.rendering.texture_losses`: sampling, Cauchy losses and gradients in one pass.

Channels lie side by side in memory, so that the taps of a pixel are vectors. A sum of logarithms is the logarithm
of a product, taken for 64 factors at a time.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from tracking3d.rendering.kernels.compilation import OPTIONS, REORDER, array, get_num_threads, kernel, share

_PIXELS, _ROWS, _WORK = 4000, 64, 400_000  # worth another thread: pixels, rows, values of pixels


class TextureLosses(torch.autograd.Function):
    """``(P,)`` Cauchy loss at every pixel and total variation, from channels-last tensors.

    Inputs are texture ``(H, W, C)``, uv ``(P, 2)``, observed ``(N, C)``, pixels ``(P,)`` which are rows of it,
    the scale, and whether the total variation is wanted; it is 0 otherwise.
    """

    @staticmethod
    def forward(
        ctx: Any, texture: Tensor, uv: Tensor, observed: Tensor, pixels: Tensor, scale: float, smooth: bool
    ) -> tuple[Tensor, Tensor]:
        if len(pixels) and not (0 <= int(pixels.min()) and int(pixels.max()) < len(observed)):
            raise IndexError(
                f"pixels go from {int(pixels.min())} to {int(pixels.max())}, but there are {len(observed)}"
            )
        loss = torch.empty(len(uv), dtype=torch.float32)
        arrays = [array(part) for part in (texture, uv, observed, pixels)]
        share(_appearance, len(uv), _PIXELS, *arrays, scale, loss.numpy())
        variation = 0.0
        if smooth:
            sums = np.zeros((2, len(texture)))
            share(_variation, len(texture), _ROWS, arrays[0], scale, sums)
            right, below = sums.sum(1)
            variation = right / texture.numel() + below / max(texture[1:].numel(), 1)
        ctx.save_for_backward(texture, uv, observed, pixels)
        ctx.scale, ctx.smooth = scale, smooth
        return loss, torch.tensor(variation, dtype=texture.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor, grad_variation: Tensor) -> tuple[Tensor | None, ...]:
        arrays = [array(part) for part in ctx.saved_tensors]
        texture, uv = arrays[:2]
        for_texture = ctx.needs_input_grad[0]
        work = len(uv) * texture.shape[2]
        parts = max(1, min(get_num_threads(), work // _WORK)) if for_texture else 1
        # Each thread adds to a texture of its own; the first one's starts with the total variation's gradient.
        grad_textures = (
            torch.zeros(parts, *texture.shape, dtype=torch.float32)
            if for_texture
            else torch.zeros(1, 0, 0, 0, dtype=torch.float32)
        )
        if for_texture and ctx.smooth:
            first = grad_textures[0].numpy()
            share(_variation_slope, len(texture), _ROWS, texture, ctx.scale, float(grad_variation), first)
        grad_uv = torch.zeros(uv.shape, dtype=torch.float32)
        outputs = array(grad_loss), grad_textures.numpy(), grad_uv.numpy()
        share(_appearance_slope, parts, 1, *arrays, ctx.scale, *outputs)
        grad_texture = grad_textures[0] if parts == 1 else grad_textures.sum(0)
        return grad_texture if for_texture else None, grad_uv, None, None, None, None


@numba.njit(inline="always", **OPTIONS)
def taps_of(u, v, height, width):
    """Two rows, two columns, the place between them, and whether v is free to move."""
    x = (u - np.floor(u)) * np.float32(width) - np.float32(0.5)
    y = v * np.float32(height) - np.float32(0.5)
    last = np.float32(height - 1)
    free = y > 0 and y < last
    y = min(max(y, np.float32(0)), last)
    left, top = int(np.floor(x)), int(y)
    bottom = min(top + 1, height - 1)
    right = left + 1 if left + 1 < width else 0
    fx, fy = x - np.float32(left), y - np.float32(top)
    return top, bottom, left if left >= 0 else width - 1, right, fx, fy, free


@numba.njit(inline="always", **OPTIONS)
def _factor(residual, i, sharpness):
    return np.float32(1) + residual[i] * residual[i] * sharpness


@numba.njit(inline="always", **OPTIONS)
def _sum_of_cauchy(residual, count, sharpness):
    """Sum of ``log(1 + sharpness r^2)`` of the first ``count`` values."""
    whole = count - count % 64
    total = 0.0
    for start in range(0, whole, 64):
        product = 1.0
        for i in range(start, start + 16):
            product *= np.float64(
                _factor(residual, i, sharpness)
                * _factor(residual, i + 16, sharpness)
                * _factor(residual, i + 32, sharpness)
                * _factor(residual, i + 48, sharpness)
            )
        total += math.log(product)
    product = 1.0
    for i in range(whole, count):
        product *= np.float64(_factor(residual, i, sharpness))
    total += math.log(product)
    if math.isinf(total):  # a product was too large
        total = 0.0
        for i in range(count):
            total += math.log(1 + np.float64(residual[i]) ** 2 * sharpness)
    return total


@numba.njit(inline="always", **OPTIONS)
def _compare(texture, taps, target, residual, channels, sharpness):
    """Sum of the losses of one pixel."""
    w00, w01, w10, w11 = bilinear_weights(taps)
    t00, t01, t10, t11 = texels_at(texture, taps)
    for c in range(channels):
        residual[c] = w00 * t00[c] + w01 * t01[c] + w10 * t10[c] + w11 * t11[c] - target[c]
    return _sum_of_cauchy(residual, channels, sharpness)


@numba.njit(inline="always", **OPTIONS)
def _compare_slope(texture, taps, target, slope, channels, sharpness, weight, out):
    """Slopes of ``weight`` times the loss of one pixel by x and y in texels; adds those by texels to ``out``."""
    one = np.float32(1)
    top, bottom, left, right, fx, fy, _ = taps
    w00, w01, w10, w11 = bilinear_weights(taps)
    t00, t01, t10, t11 = texels_at(texture, taps)
    by_x, by_y = np.float32(0), np.float32(0)
    for c in range(channels):
        d = w00 * t00[c] + w01 * t01[c] + w10 * t10[c] + w11 * t11[c] - target[c]
        g = weight * d / (one + d * d * sharpness)
        slope[c] = g
        by_x += g * ((one - fy) * (t01[c] - t00[c]) + fy * (t11[c] - t10[c]))
        by_y += g * ((one - fx) * (t10[c] - t00[c]) + fx * (t11[c] - t01[c]))
    if out.size:
        _add(out[top, left], w00, slope, channels)
        _add(out[top, right], w01, slope, channels)
        _add(out[bottom, left], w10, slope, channels)
        _add(out[bottom, right], w11, slope, channels)
    return by_x, by_y


@numba.njit(inline="always", **OPTIONS)
def texels_at(texture, taps):
    """The four texels ``(C,)``, row by row."""
    top, bottom, left, right, _, _, _ = taps
    return texture[top, left], texture[top, right], texture[bottom, left], texture[bottom, right]


@numba.njit(inline="always", **OPTIONS)
def bilinear_weights(taps):
    """Weights of the four texels, row by row."""
    _, _, _, _, fx, fy, _ = taps
    one = np.float32(1)
    return (one - fy) * (one - fx), (one - fy) * fx, fy * (one - fx), fy * fx


@numba.njit(inline="always", **OPTIONS)
def _add(target, factor, values, count):
    """``target += factor * values``."""
    for c in range(count):
        target[c] += factor * values[c]


# RGB has a path of its own in both kernels: a loop of known length is not a loop any more.


@kernel(
    "void(float32[:,:,::1], float32[:,::1], float32[:,::1], int64[::1], float64, float32[::1], int64, int64)",
    fastmath=REORDER,
)
def _appearance(texture, uv, observed, pixels, scale, loss, first, last):
    height, width, channels = texture.shape
    sharpness = np.float32(1 / scale**2)
    residual = np.empty(channels, np.float32)
    for place in range(first, last):
        u, v = uv[place]
        if not (math.isfinite(u) and math.isfinite(v)):
            loss[place] = np.nan
            continue
        taps, target = taps_of(u, v, height, width), observed[pixels[place]]
        if channels == 3:
            loss[place] = _compare(texture, taps, target, residual, 3, sharpness) / 3
        else:
            loss[place] = _compare(texture, taps, target, residual, channels, sharpness) / channels


@kernel(
    "void(float32[:,:,::1], float32[:,::1], float32[:,::1], int64[::1], float64, float32[::1],"
    " float32[:,:,:,::1], float32[:,::1], int64, int64)",
    fastmath=REORDER,
)
def _appearance_slope(texture, uv, observed, pixels, scale, grad, grad_textures, grad_uv, first, last):
    """Gradients from the pixels in parts ``first`` to ``last`` of ``len(grad_textures)``."""
    height, width, channels = texture.shape
    sharpness = np.float32(1 / scale**2)
    parts = len(grad_textures)
    slope, out = np.empty(channels, np.float32), grad_textures[first]
    for place in range(len(uv) * first // parts, len(uv) * last // parts):
        weight = np.float32(2) * sharpness * grad[place] / np.float32(channels)
        u, v = uv[place]
        if weight == 0 or not (math.isfinite(u) and math.isfinite(v)):
            continue
        taps, target = taps_of(u, v, height, width), observed[pixels[place]]
        if channels == 3:
            by_x, by_y = _compare_slope(texture, taps, target, slope, 3, sharpness, weight, out)
        else:
            by_x, by_y = _compare_slope(texture, taps, target, slope, channels, sharpness, weight, out)
        grad_uv[place, 0] = by_x * np.float32(width)
        if taps[6]:  # v is free to move
            grad_uv[place, 1] = by_y * np.float32(height)


@numba.njit(inline="always", **OPTIONS)
def _subtract(a, b, out):
    for i in range(len(out)):
        out[i] = a[i] - b[i]


@kernel("void(float32[:,:,::1], float64, float64[:,::1], int64, int64)", fastmath=REORDER)
def _variation(texture, scale, sums, first, last):
    """Sums of the losses between every texel and its right one, and the one below, for each row."""
    height, width, channels = texture.shape
    rows = texture.reshape(height, width * channels)
    sharpness = np.float32(1 / scale**2)
    residual = np.empty(width * channels, np.float32)
    for y in range(first, last):
        row = rows[y]
        _subtract(row[:-channels], row[channels:], residual[:-channels])
        _subtract(row[-channels:], row[:channels], residual[-channels:])
        sums[0, y] = _sum_of_cauchy(residual, len(residual), sharpness)
        if y + 1 < height:
            _subtract(row, rows[y + 1], residual)
            sums[1, y] = _sum_of_cauchy(residual, len(residual), sharpness)


@numba.njit(fastmath=REORDER, **OPTIONS)
def _slope(a, b, sharpness, factor, out):
    """Slope of ``factor`` times the loss between two vectors by the first; by the second it is the opposite."""
    scale = np.float32(2 * factor) * sharpness
    for i in range(len(out)):
        d = a[i] - b[i]
        out[i] = scale * d / (np.float32(1) + d * d * sharpness)


@kernel("void(float32[:,:,::1], float64, float64, float32[:,:,::1], int64, int64)", fastmath=REORDER)
def _variation_slope(texture, scale, grad, grad_texture, first, last):
    """Writes the rows ``first`` to ``last`` of the texture's gradient."""
    height, width, channels = texture.shape
    n = width * channels
    rows, grads = texture.reshape(height, n), grad_texture.reshape(height, n)
    sharpness = np.float32(1 / scale**2)
    right, below = grad / (height * n), grad / (max(height - 1, 1) * n)
    above, under, across = np.zeros(n, np.float32), np.zeros(n, np.float32), np.empty(n, np.float32)
    if first > 0:
        _slope(rows[first - 1], rows[first], sharpness, below, above)
    for y in range(first, last):
        row, out = rows[y], grads[y]
        _slope(row[:-channels], row[channels:], sharpness, right, across[:-channels])
        _slope(row[-channels:], row[:channels], sharpness, right, across[-channels:])
        if y + 1 < height:
            _slope(row, rows[y + 1], sharpness, below, under)
        else:
            under[:] = 0
        for i in range(n):
            out[i] = across[i] + under[i] - above[i]
        head, tail = out[:channels], out[channels:]
        _subtract(head, across[-channels:], head)
        _subtract(tail, across[:-channels], tail)
        above, under = under, above
