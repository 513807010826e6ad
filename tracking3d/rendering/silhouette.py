"""The soft silhouette of DIB-R (Chen et al., NeurIPS 2019), with its closed-form gradient.

Covered pixels are 1 and have no gradient. At an uncovered pixel every face whose screen box, grown by
``boxlen``, contains the pixel adds a factor: ``1 - S = prod_k (1 - exp(-sigma d_k^2))`` with d the distance to
the nearest edge of the face in NDC ([-1, 1] across the window). Back faces count as well, the first ``knum``
faces in index order only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from tracking3d.geometry.camera import NEAR
from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.surface import check_shapes
from tracking3d.rendering.visibility import expand_ranges, face_corners, gather

SIGMA = 7000.0
BOXLEN = 0.02
KNUM = 30
_EPSILON = 1e-7  # the reference's: keeps 1 / (1 - e) finite where a pixel lies on an edge
_LEAST = -60.0  # exp of less changes no sum, but denormal numbers are slow


def soft_silhouette(
    screen: Tensor,
    depth: Tensor,
    faces: Tensor,
    face_index: Tensor,
    sigma: float = SIGMA,
    boxlen: float = BOXLEN,
    knum: int = KNUM,
    backend: str = "auto",
) -> Tensor:
    """Soft silhouette ``(B, H, W)`` in [0, 1], differentiable in ``screen``.

    A view with a vertex that is not finite is NaN where it is uncovered, so that a loss on it shows.

    Args:
        screen: ``(B, V, 2)`` vertices in pixels.
        depth: ``(B, V)`` z in camera coordinates; faces too near are left out.
        faces: ``(F, 3)`` int64.
        face_index: ``(B, H, W)`` int64 from `rasterize`, -1 where uncovered.
        sigma: Sharpness per squared NDC unit.
        boxlen: Reach beyond a face's box in NDC.
        knum: Most faces that count at a pixel.
        backend: See `tracking3d.rendering.backend`.

    Raises:
        ValueError: If a shape does not fit, or no face is to count.
    """
    check_shapes(
        screen=(screen, "B V 2"), depth=(depth, "B V"), faces=(faces, "F 3"), face_index=(face_index, "B H W")
    )
    if knum < 1:
        raise ValueError(f"knum is {knum}; give the number of faces that count at a pixel, one or more")
    if use_numba(backend, screen, depth):
        from tracking3d.rendering.kernels.silhouette import SoftSilhouette

        drawn: Tensor = SoftSilhouette.apply(
            screen, depth, faces, face_index, NEAR, sigma, boxlen, knum, _EPSILON
        )
        return drawn
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
        x, y = _ndc(screen[..., 0], width), _ndc(screen[..., 1], height)
        pairs = _pairs_near_uncovered(x, y, depth, faces, face_index < 0, boxlen)
        kept = _first_per_pixel(pairs.pixel, knum, face_index.numel())
        if kept is not None:
            box, column, row, pixel = (
                gather(part, kept) for part in (pairs.box, pairs.x, pairs.y, pairs.pixel)
            )
            pairs = _Pairs(pairs.vertex, box, column, row, pixel)

        # Planes (3, M) and then (3, N), one for the edge from each corner to the next.
        following = pairs.vertex.roll(-1, 0)
        ax, ay = gather(x, pairs.vertex), gather(y, pairs.vertex)
        ex, ey = gather(x, following) - ax, gather(y, following) - ay
        length2 = (ex.square() + ey.square()).clamp_min(torch.finfo(screen.dtype).tiny)
        ax, ay, ex, ey, length2 = (plane.index_select(1, pairs.box) for plane in (ax, ay, ex, ey, length2))
        dx = gather(_ndc(torch.arange(width).to(x), width), pairs.x) - ax
        dy = gather(_ndc(torch.arange(height).to(y), height), pairs.y) - ay
        t = ((dx * ex + dy * ey) / length2).clamp(0, 1)
        rx, ry = dx - t * ex, dy - t * ey
        d2 = rx.square() + ry.square()
        nearest = d2.amin(0)
        e = torch.exp((-sigma * nearest).clamp_min(_LEAST))
        sound = screen.isfinite().flatten(1).all(1)[:, None, None]
        log_rest = torch.where(face_index < 0, torch.where(sound, 0.0, torch.nan).to(x), -torch.inf).reshape(
            -1
        )
        rest = log_rest.index_add_(0, pairs.pixel, torch.log1p(-e)).exp_()

        slope = 2 * sigma * e * gather(rest, pairs.pixel) / (1 - e + _EPSILON)  # dS/d(nearest) = -slope / 2
        side = (d2[0] > nearest).long() * (1 + (d2[1] > nearest).long())
        at_side = side * len(side) + torch.arange(len(side), device=side.device)
        box = side * len(pairs.vertex[0]) + pairs.box
        ctx.save_for_backward(
            pairs.pixel,
            gather(pairs.vertex, box),
            gather(following, box),
            gather(t, at_side),
            slope * gather(rx, at_side),
            slope * gather(ry, at_side),
        )
        ctx.shapes = screen.shape, (width, height)
        return 1 - rest.reshape(batch, height, width)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None, None, None, None]:
        pixel, near, far, t, *directions = ctx.saved_tensors
        shape, sides = ctx.shapes
        # d(d2)/da = -2 (1 - t) r and d(d2)/db = -2 t r for the nearest point a + t (b - a).
        at_pixel = gather(grad, pixel)
        by_far = at_pixel * t
        by_near = at_pixel - by_far
        planes = []
        for direction, side in zip(directions, sides, strict=True):
            plane = grad.new_zeros(shape[:2]).reshape(-1)
            plane.index_add_(0, near, by_near * direction).index_add_(0, far, by_far * direction)
            planes.append(plane * (2 / side))
        return torch.stack(planes, 1).reshape(shape), None, None, None, None, None, None


def _ndc(position: Tensor, side: int) -> Tensor:
    """From pixels to [-1, 1] across ``side`` pixels: pixel i lies at (2 i + 1 - side) / side."""
    return (2 * position + (1 - side)) / side


@dataclass(frozen=True, eq=False)
class _Pairs:
    """M boxes of faces with uncovered pixels in them, and the N pairs of a face and a pixel, in index order.

    Attributes:
        vertex: ``(3, M)`` corners of each face, as rows of ``screen.flatten(0, 1)``.
        box: ``(N,)`` which box.
        x, y, pixel: ``(N,)`` column and row of the pixel, and its index in ``(B, H, W)`` flattened.
    """

    vertex: Tensor
    box: Tensor
    x: Tensor
    y: Tensor
    pixel: Tensor


def _pairs_near_uncovered(
    x: Tensor, y: Tensor, depth: Tensor, faces: Tensor, uncovered: Tensor, boxlen: float
) -> _Pairs:
    """Uncovered pixels in the grown box of each face; x and y are ``(B, V)`` in NDC."""
    _, height, width = uncovered.shape
    bounds = []
    for plane, side in ((x, width), (y, height)):
        corner = face_corners(plane, faces)
        # A box takes the pixels low <= pixel < high.
        for limit in (corner.amin(1) - boxlen, corner.amax(1) + boxlen):
            bounds.append((((limit + 1) * side - 1) / 2).ceil().clamp(0, side))
    x0, x1, y0, y1 = bounds
    drawn = (face_corners(depth, faces).amin(1) > NEAR) & (x0 < x1) & (y0 < y1)
    view, face = torch.nonzero(drawn, as_tuple=True)
    at = view * len(faces) + face
    x0, x1, y0, y1 = (gather(bound, at).long() for bound in bounds)

    # Most boxes hold no uncovered pixel: an integral image tells at once.
    sums = uncovered.cumsum(1, dtype=torch.int32).cumsum(2, dtype=torch.int32)
    integral = functional.pad(sums, (1, 0, 1, 0))
    top, bottom = ((view * (height + 1) + row) * (width + 1) for row in (y0, y1))
    count = gather(integral, bottom + x1) - gather(integral, bottom + x0)
    count = count - gather(integral, top + x1) + gather(integral, top + x0)
    some = torch.nonzero(count)[:, 0]
    view, face, x0, x1, y0, y1 = (gather(part, some) for part in (view, face, x0, x1, y0, y1))

    # Those in one row of a box are neighbours in the list of all uncovered pixels.
    pixels = torch.nonzero(uncovered.reshape(-1))[:, 0]
    before = functional.pad(uncovered.reshape(-1).cumsum(0), (1, 0))
    box, row = expand_ranges(y0, y1 - y0)
    start = (gather(view, box) * height + row) * width
    first, end = (gather(before, start + gather(bound, box)) for bound in (x0, x1))
    line, listed = expand_ranges(first, end - first)
    pixel = gather(pixels, listed)
    vertex = faces.index_select(0, face).T + view * x.shape[1]
    return _Pairs(vertex, gather(box, line), pixel - gather(start, line), gather(row, line), pixel)


def _first_per_pixel(pixel: Tensor, knum: int, pixels: int) -> Tensor | None:
    """Positions of the first ``knum`` entries of every pixel, in order; None if that is all of them."""
    full = torch.bincount(pixel, minlength=pixels) > knum
    crowded = torch.nonzero(gather(full, pixel))[:, 0]
    if len(crowded) == 0:
        return None
    order = gather(crowded, torch.argsort(gather(pixel, crowded), stable=True))
    ordered = gather(pixel, order)
    position = torch.arange(len(order), device=pixel.device)
    starts = torch.ones_like(ordered, dtype=torch.bool)
    starts[1:] = ordered[1:] != ordered[:-1]
    rank = position - torch.where(starts, position, 0).cummax(0).values
    kept = torch.ones_like(pixel, dtype=torch.bool)
    kept[order[rank >= knum]] = False
    return torch.nonzero(kept)[:, 0]
