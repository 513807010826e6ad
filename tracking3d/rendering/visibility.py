"""Which face is seen at every pixel: the hard, non-differentiable part of the renderer.

Pairs of (face, pixel) are expanded as ragged lists, never as a dense product, and the depth test is a
`scatter_reduce`. An edge shared by two faces is evaluated from the same end point in both, so that neighbours
agree bit for bit: no cracks. A pixel exactly on an edge belongs to the nearer face, then to the lower index.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tracking3d.geometry.camera import NEAR
from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.surface import check_shapes


@dataclass(frozen=True, eq=False)
class Visibility:
    """The nearest front-facing face at every pixel."""

    face_index: Tensor  # (B, H, W) int64, -1 where no face is
    depth: Tensor  # (B, H, W) z in camera coordinates, infinite where no face is
    pixels: Tensor  # (P,) int64, flat indices of the covered pixels in (B, H, W), rising


def expand_ranges(first: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """List the integers of all ranges ``first, first + 1, ...``, one range after the other.

    Args:
        first: ``(M,)`` int64.
        count: ``(M,)`` int64, how many integers each range has.

    Returns:
        ``(N,)`` which range each integer belongs to, and ``(N,)`` the integers.
    """
    owner = torch.repeat_interleave(count)
    before = count.cumsum(0) - count
    return owner, torch.arange(len(owner), device=count.device) + (first - before).index_select(0, owner)


def face_corners(plane: Tensor, faces: Tensor) -> Tensor:
    """``(B, 3, F)`` values at the corners of every face, from ``(B, V)`` values at the vertices."""
    return plane.contiguous().index_select(1, faces.T.reshape(-1)).reshape(len(plane), 3, len(faces))


def gather(plane: Tensor, index: Tensor) -> Tensor:
    """``plane.flatten()[index]``, for an index of any shape."""
    # index_select on one dimension is several times faster than indexing with a tensor.
    return plane.reshape(-1).index_select(0, index.reshape(-1)).reshape(index.shape)


@torch.no_grad()
def rasterize(
    screen: Tensor, depth: Tensor, faces: Tensor, size: tuple[int, int], backend: str = "auto"
) -> Visibility:
    """Find the nearest front-facing face at every pixel centre.

    Args:
        screen: ``(B, V, 2)`` vertices in pixels; pixel (0, 0) is the centre of the top-left pixel. Faces with a
            vertex that is not finite are not drawn.
        depth: ``(B, V)`` z in camera coordinates.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside; faces seen from behind are culled.
        size: ``(H, W)``.
        backend: See `tracking3d.rendering.backend`.

    Raises:
        ValueError: If a shape does not fit.
    """
    check_shapes(screen=(screen, "B V 2"), depth=(depth, "B V"), faces=(faces, "F 3"))
    if use_numba(backend, screen, depth):
        from tracking3d.rendering.kernels import visibility

        return Visibility(*visibility.rasterize(screen, depth, faces, size, NEAR))
    batch, (height, width) = len(screen), size
    view, face, area, (x0, x1, y0, y1) = _boxes_in_front(screen, depth, faces, size)
    vertex = faces.index_select(0, face).T + view * screen.shape[1]  # (3, M) in screen.flatten(0, 1)
    box, y = expand_ranges(y0, y1 - y0 + 1)  # rows of the boxes
    row, x = expand_ranges(gather(x0, box), gather(x1 - x0 + 1, box))
    row_start = (gather(view, box) * height + y) * width

    # The edge functions of a pixel; what depends on its row only is computed once for the row.
    ox, oy, ex, ey = (plane.index_select(1, box) for plane in _directed_edges(screen, vertex))
    along, ox, ey = (plane.index_select(1, row) for plane in (ex * (y - oy), ox, ey))
    w = along - ey * (x - ox)  # (3, N)
    inside = torch.nonzero(w.amin(0) >= 0)[:, 0]
    row = gather(row, inside)
    owner = gather(box, row)
    by_weight = (gather(depth, vertex).reciprocal() * area.reciprocal()).index_select(1, owner)
    inverse_depth = (w.index_select(1, inside) * by_weight).sum(0)
    inverse_depth = torch.where(inverse_depth > 0, inverse_depth, 0.0)  # nor NaN: not seen
    pixel = gather(row_start, row) + gather(x, inside)

    nearest = screen.new_zeros(batch * height * width)
    nearest.scatter_reduce_(0, pixel, inverse_depth, "amax")
    wins = (inverse_depth > 0) & (inverse_depth == gather(nearest, pixel))
    claimant = torch.where(wins, gather(face, owner), len(faces))
    face_index = torch.full((batch * height * width,), -1, device=screen.device)
    face_index.scatter_reduce_(0, pixel, claimant, "amin", include_self=False)
    face_index.masked_fill_(face_index == len(faces), -1)
    shape = (batch, height, width)
    covered = torch.nonzero(face_index >= 0)[:, 0]
    return Visibility(face_index.reshape(shape), nearest.reciprocal().reshape(shape), covered)


@torch.no_grad()
def nearest_depth(
    screen: Tensor, depth: Tensor, faces: Tensor, size: tuple[int, int], backend: str = "auto"
) -> Tensor:
    """``(H, W)`` `Visibility.depth` of one view, ``(V, 2)`` and ``(V,)``: a third of the time, if no face is asked."""
    if use_numba(backend, screen, depth):
        from tracking3d.rendering.kernels import visibility

        check_shapes(screen=(screen, "V 2"), depth=(depth, "V"), faces=(faces, "F 3"))
        return visibility.nearest_depth(screen, depth, faces, size, NEAR)
    return rasterize(screen[None], depth[None], faces, size, backend).depth[0]


def _boxes_in_front(
    screen: Tensor, depth: Tensor, faces: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, list[Tensor]]:
    """Faces that may be seen: ``(M,)`` view, face, twice the area, and bounds x0, x1, y0, y1, all inclusive."""
    height, width = size
    x, y, z = (face_corners(plane, faces) for plane in (*screen.unbind(2), depth))
    # Twice the area on the screen; positive in front, for y points down.
    area = (y[:, 1] - y[:, 0]) * (x[:, 2] - x[:, 0]) - (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0])
    x0, y0 = x.amin(1).ceil().clamp(0, width), y.amin(1).ceil().clamp(0, height)
    x1, y1 = x.amax(1).floor().clamp(-1, width - 1), y.amax(1).floor().clamp(-1, height - 1)
    drawn = (area > 0) & area.isfinite() & (z.amin(1) > NEAR) & (x0 <= x1) & (y0 <= y1)
    view, face = torch.nonzero(drawn, as_tuple=True)
    return view, face, area[view, face], [bound[view, face].long() for bound in (x0, x1, y0, y1)]


def _directed_edges(screen: Tensor, vertex: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Edges of M faces as ``(3, M)`` planes: x and y of where each begins, and of its direction.

    Edge i lies opposite corner i. It begins at its end with the lower vertex index, whichever face it is seen
    from, and its direction changes sign with the face.

    Args:
        screen: ``(B, V, 2)``.
        vertex: ``(3, M)`` corners of the faces, as rows of ``screen.flatten(0, 1)``.
    """
    start, end = vertex.roll(-1, 0), vertex.roll(-2, 0)
    first, second = torch.minimum(start, end), torch.maximum(start, end)
    sign = torch.where(start > end, 1.0, -1.0).to(screen.dtype)
    x, y = screen.unbind(2)
    ox, oy = gather(x, first), gather(y, first)
    return ox, oy, (gather(x, second) - ox) * sign, (gather(y, second) - oy) * sign
