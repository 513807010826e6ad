"""The silhouette's contour against a signed distance: a term that pulls from any distance, and on edges only.

The contour consists of mesh edges between a front face and a back face (or the rim of an open mesh) with nothing of
the mesh beyond them on the screen. Points on them, about one a pixel, should lie where the distance to the mask's
outline is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from tracking3d.geometry.camera import NEAR, pixel_distance
from tracking3d.rendering.normal_equations import NormalEquations, screen_motion
from tracking3d.rendering.renderer import Rendering
from tracking3d.rendering.surface import check_shapes, edges_of
from tracking3d.rendering.surface_visibility import front_faces
from tracking3d.rendering.texture_losses import cauchy
from tracking3d.rendering.visibility import expand_ranges

MOST_ON_AN_EDGE = 256
"""Points on one edge, however large it seems."""
PROBE = 1.0
"""Pixels beyond an edge where the mesh must have ended."""


@dataclass(frozen=True, eq=False)
class Contour:
    """Points on the contours of B frames."""

    view: Tensor  # (N,) int64, the frame of each point
    position: Tensor  # (N, 2) pixels; differentiable in the rendering's vertices, poses and cameras
    normal: Tensor  # (N, 2) unit normals on the screen, outward
    length: Tensor  # (N,) pixels of contour that each point stands for, without gradient
    points: Tensor  # (N, 3) the surface points in camera coordinates, without gradient
    vertices: Tensor  # (N, 2) int64, the ends of the edge that each point lies on
    share: Tensor  # (N, 2) how much of each end the surface point is in space, without gradient; sums to 1
    frames: int  # B


def find_contour(drawn: Rendering, edges: tuple[Tensor, Tensor] | None = None) -> Contour:
    """The contour of every frame's silhouette; parts of it outside the window are left out.

    The ``edges`` are those of the faces, by `edges_of`; they are found if None.
    """
    view, begin, end = _contour_edges(drawn, edges or edges_of(drawn.faces))
    along = drawn.screen[view, end] - drawn.screen[view, begin]
    length = along.detach().norm(dim=1)
    count = length.ceil().clamp(1, MOST_ON_AN_EDGE).long()
    owner, number = expand_ranges(torch.zeros_like(count), count)
    fraction = (number.to(length) + 0.5) / count[owner]
    view, begin, end, along = view[owner], begin[owner], end[owner], along[owner]
    position = drawn.screen[view, begin] + fraction[:, None] * along
    with torch.no_grad():
        direction = functional.normalize(along, dim=1)
        normal = torch.stack([-direction[:, 1], direction[:, 0]], 1)
        _, height, width = drawn.face_index.shape
        inside = _nearest_pixel(position, height, width)[1]
        beyond, in_window = _nearest_pixel(position + PROBE * normal, height, width)
        covered = drawn.face_index.flatten()[view * height * width + beyond] >= 0
        kept = torch.nonzero(inside & ~(covered & in_window))[:, 0]
        vertices = torch.stack([begin, end], 1)[kept]
        ends = drawn.x_cam[view[kept][:, None], vertices]
        # Perspective: on the screen it is the inverse depth that is mixed.
        share = torch.stack([1 - fraction, fraction], 1)[kept] / ends[..., 2]
        share = share / share.sum(1, keepdim=True)
        points = (share[..., None] * ends).sum(1)
    each = (length / count)[owner]
    return Contour(
        view[kept], position[kept], normal[kept], each[kept], points, vertices, share, len(drawn.screen)
    )


def contour_loss(contour: Contour, distance: Tensor, scale: float) -> Tensor:
    """``(B,)`` mean Cauchy loss of the contour's signed distances; differentiable in the contour's positions.

    Args:
        contour: From `find_contour`.
        distance: ``(B, H, W)`` from `signed_distance`.
        scale: Pixels at which the loss is ``log 2``.

    Returns:
        0 for a frame without contour.
    """
    residual = contour_distance(contour, distance)
    loss = cauchy(residual, torch.zeros_like(residual), scale) * contour.length
    return _per_frame(contour, loss) / _per_frame(contour, contour.length).clamp_min(1.0)


def contour_distance(contour: Contour, distance: Tensor) -> Tensor:
    """``(N,)`` signed distance ``(B, H, W)`` at the contour's points, between the pixels."""
    check_shapes(distance=(distance, f"{contour.frames} H W"))
    value, _, _ = _sample_contour(contour, distance)
    return value


@torch.no_grad()
def contour_slopes(contour: Contour, distance: Tensor) -> tuple[Tensor, Tensor]:
    """`contour_distance` and its slopes ``(N, 2)`` by x and y, without gradient."""
    value, by_x, by_y = _sample_contour(contour, distance)
    return value, torch.stack([by_x, by_y], 1)


@torch.no_grad()
def contour_normal_equations(
    drawn: Rendering, contour: Contour, distance: Tensor, pivot: Tensor, scale: float
) -> NormalEquations:
    """Normal equations of `contour_loss` in the poses, see `tracking3d.rendering.pose_normal_equations`.

    Args:
        drawn: The rendering that the contour is of.
        contour: From `find_contour`.
        distance: ``(B, H, W)`` from `signed_distance`.
        pivot: ``(B, 3)`` what rotations turn about, in camera coordinates.
        scale: Pixels at which the loss is ``log 2``.
    """
    residual, slope = contour_slopes(contour, distance)
    share = contour.length / _per_frame(contour, contour.length).clamp_min(1.0)[contour.view]
    motion = screen_motion(contour.points, drawn.K[contour.view], pivot[contour.view])
    jacobian = torch.einsum("ni,nia->na", slope, motion)
    weight = share * 2 / (scale**2 + residual.square())
    matrix = torch.einsum("na,n,nb->nab", jacobian, weight, jacobian)
    gradient = (weight * residual)[:, None] * jacobian
    cost = share * cauchy(residual, torch.zeros_like(residual), scale)
    return NormalEquations(*(_per_frame(contour, part) for part in (matrix, gradient, cost)))


def signed_distance(mask: Tensor) -> Tensor:
    """``(B, H, W)`` distance in pixels to the outline of ``mask`` ``(B, H, W)``, negative inside.

    The outline runs half-way between pixels inside (above 0.5) and pixels outside. A mask without an outline in the
    window gives zeros, which pull nowhere. The mask is not differentiated.
    """
    inside = (mask > 0.5).cpu().numpy()
    result = np.zeros(inside.shape, np.float32)
    for view, part in enumerate(inside):
        if part.any() and not part.all():
            result[view] = np.where(part, 0.5 - pixel_distance(~part), pixel_distance(part) - 0.5)
    return torch.from_numpy(result).to(mask)


@torch.no_grad()
def _contour_edges(drawn: Rendering, edges: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """View, first and second vertex of the edges between front and back, as front faces go around them."""
    faces = drawn.faces
    start, end = faces.reshape(-1), faces.roll(-1, 1).reshape(-1)
    edge, shared = edges[0].reshape(-1), edges[1]
    in_front = (drawn.x_cam[..., 2] > NEAR)[:, faces].all(2)
    front = front_faces(drawn.screen, faces) & in_front
    sides = front.repeat_interleave(3, 1)  # (B, 3 F), in the order of `edge`
    fronts = torch.zeros(len(front), len(shared), device=front.device).index_add(1, edge, sides.float())
    ends_here = (fronts < shared) | (shared == 1)
    view, side = torch.nonzero(sides & ends_here[:, edge], as_tuple=True)
    return view, start[side], end[side]


def _nearest_pixel(position: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Index of the pixel in its window, and whether it lies in it."""
    column, row = position.round().long().unbind(1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return row.clamp(0, height - 1) * width + column.clamp(0, width - 1), inside


def _sample_contour(contour: Contour, distance: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Bilinear samples ``(N,)`` at the contour's positions, and their slopes by x and y; the first has a gradient."""
    _, height, width = distance.shape
    x, y = contour.position.unbind(1)
    left = x.detach().floor().clamp(0, max(width - 2, 0))
    top = y.detach().floor().clamp(0, max(height - 2, 0))
    fx, fy = x - left, y - top
    columns = [(left.long() + step).clamp_max(width - 1) for step in (0, 1)]
    rows = [(top.long() + step).clamp_max(height - 1) for step in (0, 1)]
    (d00, d01), (d10, d11) = ([distance[contour.view, row, column] for column in columns] for row in rows)
    by_x, by_y = d01 - d00 + fy * (d11 - d10 - d01 + d00), d10 - d00 + fx * (d11 - d10 - d01 + d00)
    return d00 + fx * (d01 - d00) + fy * (d10 - d00) + fx * fy * (d11 - d10 - d01 + d00), by_x, by_y


def _per_frame(contour: Contour, values: Tensor) -> Tensor:
    """``(B, ...)`` sums over the points ``(N, ...)`` of each frame."""
    total = values.new_zeros(contour.frames, *values.shape[1:])
    return total.index_add(0, contour.view, values)
