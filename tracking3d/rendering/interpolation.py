"""Perspective-correct interpolation of face attributes at covered pixels, with its closed-form gradient.

With screen barycentrics w_i and depths z_i: ``l_i = (w_i / z_i) / sum_j (w_j / z_j)`` and ``u = sum_i l_i u_i``.
Everything is computed in planes ``(3, P)``, one for each corner of the faces.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.surface import check_shapes
from tracking3d.rendering.visibility import gather


def interpolate(
    screen: Tensor,
    depth: Tensor,
    faces: Tensor,
    attributes: Tensor,
    face_index: Tensor,
    backend: str = "auto",
) -> Tensor:
    """Interpolate per-corner attributes at every covered pixel.

    Differentiable in ``screen``, ``depth`` and ``attributes``; visibility is held fixed.

    Args:
        screen: ``(B, V, 2)`` vertices in pixels.
        depth: ``(B, V)`` z in camera coordinates.
        faces: ``(F, 3)`` int64.
        attributes: ``(F, 3, D)``, one row a face corner, or ``(B, F, 3, D)`` with other ones in each view.
        face_index: ``(B, H, W)`` int64 from `rasterize`.
        backend: See `tracking3d.rendering.backend`.

    Returns:
        ``(P, D)``, one row for each covered pixel in the order of ``(face_index >= 0).nonzero()``.

    Raises:
        ValueError: If a shape does not fit.
    """
    check_shapes(
        screen=(screen, "B V 2"),
        depth=(depth, "B V"),
        faces=(faces, "F 3"),
        attributes=(attributes, "B F 3 D" if attributes.dim() == 4 else "F 3 D"),
        face_index=(face_index, "B H W"),
    )
    if attributes.dim() == 3:
        attributes = attributes[None]
    function: Any = _Interpolate
    if use_numba(backend, screen, depth, attributes):
        from tracking3d.rendering.kernels.interpolation import Interpolate as function
    result: Tensor = function.apply(screen, depth, faces, attributes, face_index)
    return result


def barycentrics(corner_x: Tensor, corner_y: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Screen barycentrics of points in triangles, and their gradient in the point.

    Args:
        corner_x, corner_y: ``(3, P)`` triangle corners.
        x, y: ``(P,)`` points.

    Returns:
        ``(3, P)`` weights that sum to 1, and their derivatives ``(3, P)`` by x and by y.
    """
    following_x, following_y = corner_x.roll(-1, 0), corner_y.roll(-1, 0)
    edge_x, edge_y = (
        corner_x.roll(-2, 0) - following_x,
        corner_y.roll(-2, 0) - following_y,
    )  # opposite corner i
    area = edge_x[1] * edge_y[2] - edge_y[1] * edge_x[2]
    by_x, by_y = -edge_y / area, edge_x / area
    return (x - following_x) * by_x + (y - following_y) * by_y, by_x, by_y


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, screen: Tensor, depth: Tensor, faces: Tensor, attributes: Tensor, face_index: Tensor
    ) -> Tensor:
        _, height, width = face_index.shape
        pixel = torch.nonzero(face_index.reshape(-1) >= 0)[:, 0]
        face = gather(face_index, pixel)
        row = torch.div(pixel, width, rounding_mode="floor")
        view = torch.div(row, height, rounding_mode="floor")
        x, y = (pixel - row * width).to(screen.dtype), (row - view * height).to(screen.dtype)
        vertex = (
            faces.T.contiguous().index_select(1, face) + view * screen.shape[1]
        )  # (3, P) in depth.flatten()
        z = gather(depth, vertex)
        w, by_x, by_y = barycentrics(gather(screen[..., 0], vertex), gather(screen[..., 1], vertex), x, y)
        weight = w / z
        s = 1 / weight.sum(0)
        share = weight * s
        if len(attributes) > 1:
            face = face + view * len(faces)
        table = attributes.flatten(0, 1)
        planes = table.permute(2, 1, 0).reshape(3 * table.shape[2], len(table))
        corner_values = planes.index_select(1, face).reshape(table.shape[2], 3, len(face))  # (D, 3, P)
        values = (share * corner_values).sum(1)  # (D, P)
        ctx.save_for_backward(vertex, face, w, by_x, by_y, z, s, share, corner_values, values)
        ctx.shapes = screen.shape, attributes.shape
        return values.T

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, Tensor | None, None]:
        vertex, face, w, by_x, by_y, z, s, share, corner_values, values = ctx.saved_tensors
        screen_shape, attributes_shape = ctx.shapes
        rows = vertex.reshape(-1)
        g = ((corner_values - values[:, None]) * grad.T[:, None]).sum(0) / z  # (3, P)
        by_weight = g * s
        planes = [-w * (by_weight * slope).sum(0) for slope in (by_x, by_y)] + [-g * share]
        grad_x, grad_y, grad_depth = (
            grad.new_zeros(screen_shape[:2]).reshape(-1).index_add_(0, rows, plane.reshape(-1))
            for plane in planes
        )
        grad_attributes = None
        if ctx.needs_input_grad[3]:
            grad_attributes = grad.new_zeros(attributes_shape)
            grad_attributes.flatten(0, 1).index_add_(0, face, share.T[..., None] * grad[:, None])
        grad_screen = torch.stack([grad_x, grad_y], 1).reshape(screen_shape)
        return grad_screen, grad_depth.reshape(screen_shape[:2]), None, grad_attributes, None
