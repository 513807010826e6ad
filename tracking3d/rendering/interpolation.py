"""Perspective-correct interpolation of face attributes at covered pixels, with its closed-form gradient.

With screen barycentrics w_i and depths z_i: ``l_i = (w_i / z_i) / sum_j (w_j / z_j)`` and ``u = sum_i l_i u_i``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def interpolate(screen: Tensor, depth: Tensor, faces: Tensor, attributes: Tensor, face_index: Tensor) -> Tensor:
    """Interpolate per-corner attributes at every covered pixel.

    Differentiable in ``screen``, ``depth`` and ``attributes``; visibility is held fixed.

    Args:
        screen: ``(B, V, 2)`` vertices in pixels.
        depth: ``(B, V)`` z in camera coordinates.
        faces: ``(F, 3)`` int64.
        attributes: ``(F, 3, D)``, one row a face corner.
        face_index: ``(B, H, W)`` int64 from `rasterize`.

    Returns:
        ``(P, D)``, one row for each covered pixel in the order of ``(face_index >= 0).nonzero()``.
    """
    result: Tensor = _Interpolate.apply(screen, depth, faces, attributes, face_index)
    return result


def barycentrics(corner: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Screen barycentrics of points in triangles, and their gradient in the point.

    Args:
        corner: ``(P, 3, 2)`` triangle corners.
        x, y: ``(P,)`` points.

    Returns:
        ``(P, 3)`` weights that sum to 1, and ``(P, 3, 2)`` their derivative by the point.
    """
    following, last = corner.roll(-1, 1), corner.roll(-2, 1)
    edge = last - following  # opposite corner i
    area = (edge[:, 2, 0] * -edge[:, 1, 1] + edge[:, 2, 1] * edge[:, 1, 0])[:, None]
    slope = torch.stack([-edge[..., 1], edge[..., 0]], 2) / area[..., None]
    to_point = torch.stack([x, y], 1)[:, None] - following
    return (to_point * slope).sum(2), slope


class _Interpolate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, screen: Tensor, depth: Tensor, faces: Tensor, attributes: Tensor, face_index: Tensor
    ) -> Tensor:
        view, y, x = torch.nonzero(face_index >= 0, as_tuple=True)
        face = face_index[view, y, x]
        vertex = view[:, None] * screen.shape[1] + faces[face]  # (P, 3)
        z = depth.reshape(-1)[vertex]
        w, slope = barycentrics(screen.reshape(-1, 2)[vertex], x.to(screen.dtype), y.to(screen.dtype))
        weight = w / z
        s = 1 / weight.sum(1, keepdim=True)
        share = weight * s
        corner_values = attributes[face]  # (P, 3, D)
        values = (share[..., None] * corner_values).sum(1)
        ctx.save_for_backward(vertex, face, w, slope, z, s, share, corner_values, values)
        ctx.shapes = screen.shape, attributes.shape
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None, Tensor | None, None]:  # type: ignore[override]
        vertex, face, w, slope, z, s, share, corner_values, values = ctx.saved_tensors
        screen_shape, attributes_shape = ctx.shapes
        g = ((corner_values - values[:, None]) * grad[:, None]).sum(2)  # (P, 3)
        by_point = (g * s / z)[:, None] @ slope  # (P, 1, 2)
        grad_screen = grad.new_zeros(screen_shape)
        grad_screen.reshape(-1, 2).index_add_(0, vertex.reshape(-1), (-w[..., None] * by_point).reshape(-1, 2))
        grad_depth = grad.new_zeros(screen_shape[:2])
        grad_depth.reshape(-1).index_add_(0, vertex.reshape(-1), (-g * share / z).reshape(-1))
        grad_attributes = None
        if ctx.needs_input_grad[3]:
            grad_attributes = grad.new_zeros(attributes_shape)
            grad_attributes.index_add_(0, face, share[..., None] * grad[:, None])
        return grad_screen, grad_depth, None, grad_attributes, None
