"""Which face is seen at every pixel: the hard, non-differentiable part of the renderer.

Pairs of (face, pixel) are expanded as ragged lists, never as a dense product, and the depth test is a
`scatter_reduce`. An edge shared by two faces is evaluated from the same end point in both, so that neighbours
agree bit for bit: no cracks. A pixel exactly on an edge belongs to the nearer face, then to the lower index.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

NEAR = 1e-3
"""Faces with a vertex nearer than this (object units, along z) are not drawn."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """The nearest front-facing face at every pixel.

    Attributes:
        face_index: ``(B, H, W)`` int64, -1 where no face is.
        depth: ``(B, H, W)`` z in camera coordinates, infinite where no face is.
    """

    face_index: Tensor
    depth: Tensor


@dataclass(frozen=True, eq=False)
class PixelPairs:
    """A ragged list of candidate (face, pixel) pairs, in the order of the boxes they come from.

    Attributes:
        box: ``(N,)`` index of the pair's box.
        x, y: ``(N,)`` int64 column and row of the pair's pixel.
    """

    box: Tensor
    x: Tensor
    y: Tensor


def expand_boxes(x0: Tensor, x1: Tensor, y0: Tensor, y1: Tensor) -> PixelPairs:
    """List all pixels of integer boxes, row by row.

    Args:
        x0, x1, y0, y1: ``(M,)`` int64, inclusive bounds, ``x0 <= x1`` and ``y0 <= y1``.
    """
    width = x1 - x0 + 1
    count = width * (y1 - y0 + 1)
    total = int(count.sum())
    box = torch.repeat_interleave(torch.arange(len(count), device=count.device), count, output_size=total)
    first = torch.cumsum(count, 0) - count
    offset = torch.arange(total, device=count.device) - first[box]
    row = torch.div(offset, width[box], rounding_mode="floor")
    return PixelPairs(box, x0[box] + offset - row * width[box], y0[box] + row)


@torch.no_grad()
def rasterize(screen: Tensor, depth: Tensor, faces: Tensor, size: tuple[int, int]) -> Visibility:
    """Find the nearest front-facing face at every pixel centre.

    Args:
        screen: ``(B, V, 2)`` vertices in pixels; pixel (0, 0) is the centre of the top-left pixel.
        depth: ``(B, V)`` z in camera coordinates.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside; faces seen from behind are culled.
        size: ``(H, W)``.
    """
    batch, height, width = screen.shape[0], *size
    device, dtype = screen.device, screen.dtype
    corner = screen[:, faces]  # (B, F, 3, 2)
    z = depth[:, faces]  # (B, F, 3)
    ab, ac = corner[:, :, 1] - corner[:, :, 0], corner[:, :, 2] - corner[:, :, 0]
    area = ab[..., 1] * ac[..., 0] - ab[..., 0] * ac[..., 1]  # positive in front: y points down
    low, high = corner.amin(2), corner.amax(2)
    x0, y0 = low[..., 0].ceil().clamp(0, width), low[..., 1].ceil().clamp(0, height)
    x1, y1 = high[..., 0].floor().clamp(-1, width - 1), high[..., 1].floor().clamp(-1, height - 1)
    drawn = (area > 0) & (z.amin(2) > NEAR) & (x0 <= x1) & (y0 <= y1)
    view, face = torch.nonzero(drawn, as_tuple=True)
    pairs = expand_boxes(*(bound[view, face].long() for bound in (x0, x1, y0, y1)))

    # Edge i lies opposite corner i and is evaluated from its end with the lower vertex index.
    start, end = faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]
    swapped = start > end
    first, second = torch.where(swapped, end, start), torch.where(swapped, start, end)
    origin = screen[:, first][view, face]  # (M, 3, 2)
    edge = screen[:, second][view, face] - origin
    edge = edge * torch.where(swapped, 1.0, -1.0).to(dtype)[face][..., None]
    coefficients = torch.cat([origin[..., 0], origin[..., 1], edge[..., 0], edge[..., 1]], 1)[pairs.box]
    ox, oy, ex, ey = coefficients.T.reshape(4, 3, -1)
    w = ex * (pairs.y.to(dtype) - oy) - ey * (pairs.x.to(dtype) - ox)  # (3, N)
    inside = torch.nonzero((w >= 0).all(0))[:, 0]
    w, box = w[:, inside], pairs.box[inside]
    inverse_depth = (w / z[view, face].T[:, box]).sum(0) / w.sum(0).clamp_min(torch.finfo(dtype).tiny)
    pixel = (view[box] * height + pairs.y[inside]) * width + pairs.x[inside]

    nearest = torch.zeros(batch * height * width, dtype=dtype, device=device)
    nearest.scatter_reduce_(0, pixel, inverse_depth, "amax")
    wins = torch.nonzero(inverse_depth == nearest[pixel])[:, 0]
    face_index = torch.full((batch * height * width,), len(faces), dtype=torch.int64, device=device)
    face_index.scatter_reduce_(0, pixel[wins], face[box[wins]], "amin")
    face_index[face_index == len(faces)] = -1
    shape = (batch, height, width)
    return Visibility(face_index.reshape(shape), nearest.reciprocal().reshape(shape))
