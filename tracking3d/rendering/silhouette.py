"""The soft silhouette of DIB-R (Chen et al., NeurIPS 2019), with its closed-form gradient.

Covered pixels are 1 and have no gradient. At an uncovered pixel every face whose screen box, grown by
``boxlen``, contains the pixel adds a factor: ``1 - S = prod_k (1 - exp(-sigma d_k^2))`` with d the distance to
the nearest edge of the face in NDC ([-1, 1] across the window). Back faces count as well, the first ``knum``
faces in index order only.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from tracking3d.rendering.visibility import NEAR, PixelPairs, expand_boxes

SIGMA = 7000.0
BOXLEN = 0.02
KNUM = 30
_CLAMP = 1e-7  # keeps 1 / (1 - e) finite where a pixel lies on an edge


def soft_silhouette(
    screen: Tensor,
    depth: Tensor,
    faces: Tensor,
    face_index: Tensor,
    sigma: float = SIGMA,
    boxlen: float = BOXLEN,
    knum: int = KNUM,
) -> Tensor:
    """Soft silhouette ``(B, H, W)`` in [0, 1], differentiable in ``screen``.

    Args:
        screen: ``(B, V, 2)`` vertices in pixels.
        depth: ``(B, V)`` z in camera coordinates; faces too near are left out.
        faces: ``(F, 3)`` int64.
        face_index: ``(B, H, W)`` int64 from `rasterize`, -1 where uncovered.
        sigma: Sharpness per squared NDC unit.
        boxlen: Reach beyond a face's box in NDC.
        knum: Most faces that count at a pixel.
    """
    result: Tensor = _SoftSilhouette.apply(screen, depth, faces, face_index, sigma, boxlen, knum)
    return result


class _SoftSilhouette(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        screen: Tensor,
        depth: Tensor,
        faces: Tensor,
        face_index: Tensor,
        sigma: float,
        boxlen: float,
        knum: int,
    ) -> Tensor:
        batch, height, width = face_index.shape
        uncovered = face_index < 0
        to_ndc = screen.new_tensor([2.0 / width, 2.0 / height])
        ndc = screen * to_ndc + (to_ndc * 0.5 - 1.0)
        view, face, pairs = _pairs_near_uncovered(ndc, depth, faces, uncovered, boxlen)
        pixel = (view[pairs.box] * height + pairs.y) * width + pairs.x
        kept = _first_per_pixel(pixel, knum, batch * height * width)
        if kept is not None:
            pixel = pixel[kept]
            pairs = PixelPairs(pairs.box[kept], pairs.x[kept], pairs.y[kept])

        vertex = view[:, None] * screen.shape[1] + faces[face]  # (M, 3) rows of ndc.flatten(0, 1)
        corner = ndc.reshape(-1, 2)[vertex]  # (M, 3, 2)
        start = corner.permute(1, 2, 0)[:, :, pairs.box]  # (3, 2, N)
        edge = start.roll(-1, 0) - start
        point = torch.stack([pairs.x, pairs.y]).to(screen.dtype) * to_ndc[:, None] + (to_ndc[:, None] * 0.5 - 1.0)
        to_point = point - start
        length2 = edge.square().sum(1).clamp_min(torch.finfo(screen.dtype).tiny)
        t = ((to_point * edge).sum(1) / length2).clamp(0, 1)  # (3, N)
        residual = to_point - t[:, None] * edge
        d2, side = residual.square().sum(1).min(0)
        column = torch.arange(len(side), device=side.device)
        e = torch.exp(-sigma * d2).clamp_max(1 - _CLAMP)
        log_rest = torch.zeros(batch * height * width, dtype=screen.dtype, device=screen.device)
        log_rest.index_add_(0, pixel, torch.log1p(-e))
        rest = log_rest.exp()
        silhouette = torch.where(uncovered, 1 - rest.reshape(batch, height, width), 1.0)

        near = vertex[pairs.box, side]
        far = vertex[pairs.box, (side + 1) % 3]
        slope = 2 * sigma * e * rest[pixel] / (1 - e)  # dS/d(d2) = -slope / 2
        ctx.save_for_backward(pixel, near, far, residual[side, :, column] * slope[:, None], t[side, column], to_ndc)
        ctx.screen_shape = screen.shape
        return silhouette

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None, None, None, None]:  # type: ignore[override]
        pixel, near, far, direction, t, to_ndc = ctx.saved_tensors
        # d(d2)/da = -2 (1 - t) r and d(d2)/db = -2 t r for the nearest point a + t (b - a).
        pull = grad.reshape(-1)[pixel, None] * direction
        result = torch.zeros(ctx.screen_shape, dtype=grad.dtype, device=grad.device).reshape(-1, 2)
        result.index_add_(0, near, (1 - t)[:, None] * pull)
        result.index_add_(0, far, t[:, None] * pull)
        return (result * to_ndc).reshape(ctx.screen_shape), None, None, None, None, None, None


def _pairs_near_uncovered(
    ndc: Tensor, depth: Tensor, faces: Tensor, uncovered: Tensor, boxlen: float
) -> tuple[Tensor, Tensor, PixelPairs]:
    """Uncovered pixels in the grown box of each face: ``(view, face)`` of each box, and the pairs."""
    batch, height, width = uncovered.shape
    size = ndc.new_tensor([width, height])
    corner = ndc[:, faces]
    # Pixel i lies at (2 i + 1 - W) / W; a box takes low <= pixel < high.
    low = (((corner.amin(2) - boxlen + 1) * size - 1) / 2).ceil()
    high = (((corner.amax(2) + boxlen + 1) * size - 1) / 2).ceil() - 1
    x0, y0 = low[..., 0].clamp(0, width).long(), low[..., 1].clamp(0, height).long()
    x1, y1 = high[..., 0].clamp(-1, width - 1).long(), high[..., 1].clamp(-1, height - 1).long()
    drawn = (depth[:, faces].amin(2) > NEAR) & (x0 <= x1) & (y0 <= y1)
    # Most boxes hold no uncovered pixel: an integral image tells at once.
    integral = torch.nn.functional.pad(uncovered.cumsum(1).cumsum(2), (1, 0, 1, 0)).reshape(-1)
    base = torch.arange(batch, device=ndc.device)[:, None] * ((height + 1) * (width + 1))
    x2, y2 = (x1 + 1).clamp_min(0), (y1 + 1).clamp_min(0)
    top, bottom = base + y0 * (width + 1), base + y2 * (width + 1)
    count = integral[bottom + x2] - integral[bottom + x0] - integral[top + x2] + integral[top + x0]
    view, face = torch.nonzero(drawn & (count > 0), as_tuple=True)
    pairs = expand_boxes(*(bound[view, face] for bound in (x0, x1, y0, y1)))
    open_pixel = torch.nonzero(uncovered[view[pairs.box], pairs.y, pairs.x])[:, 0]
    return view, face, PixelPairs(pairs.box[open_pixel], pairs.x[open_pixel], pairs.y[open_pixel])


def _first_per_pixel(pixel: Tensor, knum: int, pixels: int) -> Tensor | None:
    """Positions of the first ``knum`` entries of every pixel, in order; None if that is all of them."""
    count = torch.bincount(pixel, minlength=pixels)
    crowded = torch.nonzero((count > knum)[pixel])[:, 0]
    if len(crowded) == 0:
        return None
    order = crowded[torch.argsort(pixel[crowded], stable=True)]
    ordered = pixel[order]
    position = torch.arange(len(order), device=pixel.device)
    starts = torch.ones_like(ordered, dtype=torch.bool)
    starts[1:] = ordered[1:] != ordered[:-1]
    rank = position - torch.where(starts, position, 0).cummax(0).values
    kept = torch.ones_like(pixel, dtype=torch.bool)
    kept[order[rank >= knum]] = False
    return torch.nonzero(kept)[:, 0]
