"""Kernels of `tracking3d.rendering.interpolation`; the backward pass computes the barycentrics again."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from tracking3d.rendering.kernels.compilation import OPTIONS, array, check_corners, kernel
from tracking3d.rendering.kernels.threads import share


class Interpolate(torch.autograd.Function):
    """``(P, D)`` from screen, depth, faces, attributes, face_index, as in the module of the same name.

    ``attributes`` is ``(M, F, 3, D)``, with M = 1 for all views or M = B.
    """

    @staticmethod
    def forward(
        ctx: Any, screen: Tensor, depth: Tensor, faces: Tensor, attributes: Tensor, face_index: Tensor
    ) -> Tensor:
        index = array(face_index)
        ends = np.empty(len(index) + 1, dtype=np.int64)
        if _count(index, ends) >= len(faces):
            raise IndexError(f"face_index names face {int(index.max())}, but there are {len(faces)} faces")
        check_corners(faces, screen)
        values = torch.empty(int(ends[-1]), attributes.shape[3])
        arrays = array(screen), array(depth), array(faces), array(attributes), index, ends
        share(_forward, len(index), 2, *arrays, values.numpy())
        ctx.save_for_backward(screen, depth, faces, attributes, face_index, values)
        ctx.ends = ends
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        *inputs, values = ctx.saved_tensors
        screen, depth, _, attributes, _ = inputs
        grads = [torch.zeros(part.shape) for part in (screen, depth)]
        wanted = ctx.needs_input_grad[3]
        grad_attributes = torch.zeros(attributes.shape if wanted else (0, 0, 0, 0))
        arrays = (*map(array, inputs), ctx.ends, array(values), array(grad))
        # Views that share their attributes would add to the same places.
        views, least = len(screen), 10**9 if wanted and len(attributes) == 1 else 2
        outputs = [part.numpy() for part in (*grads, grad_attributes)]
        share(_backward, views, least, *arrays, *outputs)
        return grads[0], grads[1], None, grad_attributes if wanted else None, None


@kernel("int64(int64[:,:,::1], int64[::1])")
def _count(face_index, ends):
    """Where the rows of every view begin and end; the highest face there is."""
    ends[0] = 0
    highest = -1
    for view in range(len(face_index)):
        covered = 0
        for face in face_index[view].flat:
            covered += face >= 0
            highest = max(highest, face)
        ends[view + 1] = ends[view] + covered
    return highest


@numba.njit(inline="always", **OPTIONS)
def _barycentrics(ax, ay, bx, by, cx, cy, x, y):
    """Screen barycentrics of a point, and their slopes by x and by y, as three triples."""
    # Edge i lies opposite corner i.
    ex0, ey0, ex1, ey1, ex2, ey2 = cx - bx, cy - by, ax - cx, ay - cy, bx - ax, by - ay
    scale = np.float32(1) / (ex1 * ey2 - ey1 * ex2)
    x0, x1, x2 = -ey0 * scale, -ey1 * scale, -ey2 * scale
    y0, y1, y2 = ex0 * scale, ex1 * scale, ex2 * scale
    w0 = (x - bx) * x0 + (y - by) * y0
    w1 = (x - cx) * x1 + (y - cy) * y1
    w2 = (x - ax) * x2 + (y - ay) * y2
    return (w0, w1, w2), (x0, x1, x2), (y0, y1, y2)


@kernel(
    "void(float32[:,:,::1], float32[:,::1], int64[:,::1], float32[:,:,:,::1], int64[:,:,::1], int64[::1],"
    " float32[:,::1], int64, int64)"
)
def _forward(screen, depth, faces, attributes, face_index, ends, values, first, last):
    height, width = face_index.shape[1:]
    channels = attributes.shape[3]
    for view in range(first, last):
        corners, z = screen[view], depth[view]
        per_face = attributes[view if len(attributes) > 1 else 0]
        row = ends[view]
        for y in range(height):
            for x in range(width):
                face = face_index[view, y, x]
                if face < 0:
                    continue
                a, b, c = faces[face]
                w, _, _ = _barycentrics(
                    corners[a, 0], corners[a, 1], corners[b, 0], corners[b, 1], corners[c, 0], corners[c, 1],
                    np.float32(x), np.float32(y),
                )  # fmt: skip
                wa, wb, wc = w[0] / z[a], w[1] / z[b], w[2] / z[c]
                s = np.float32(1) / (wa + wb + wc)
                wa, wb, wc = wa * s, wb * s, wc * s
                for k in range(channels):
                    values[row, k] = (
                        wa * per_face[face, 0, k] + wb * per_face[face, 1, k] + wc * per_face[face, 2, k]
                    )
                row += 1


@kernel(
    "void(float32[:,:,::1], float32[:,::1], int64[:,::1], float32[:,:,:,::1], int64[:,:,::1], int64[::1],"
    " float32[:,::1], float32[:,::1], float32[:,:,::1], float32[:,::1], float32[:,:,:,::1], int64, int64)"
)
def _backward(
    screen, depth, faces, attributes, face_index, ends, values, grad,
    grad_screen, grad_depth, grad_attributes, first, last,
):  # fmt: skip
    height, width = face_index.shape[1:]
    channels = attributes.shape[3]
    for view in range(first, last):
        corners, z = screen[view], depth[view]
        mesh = view if len(attributes) > 1 else 0
        row = ends[view] - 1
        for y in range(height):
            for x in range(width):
                face = face_index[view, y, x]
                if face < 0:
                    continue
                row += 1
                a, b, c = faces[face]
                w, by_x, by_y = _barycentrics(
                    corners[a, 0], corners[a, 1], corners[b, 0], corners[b, 1], corners[c, 0], corners[c, 1],
                    np.float32(x), np.float32(y),
                )  # fmt: skip
                one = np.float32(1)
                ia, ib, ic = one / z[a], one / z[b], one / z[c]
                s = one / (w[0] * ia + w[1] * ib + w[2] * ic)
                ga, gb, gc = np.float32(0), np.float32(0), np.float32(0)
                for k in range(channels):
                    value, slope = values[row, k], grad[row, k]
                    ga += slope * (attributes[mesh, face, 0, k] - value)
                    gb += slope * (attributes[mesh, face, 1, k] - value)
                    gc += slope * (attributes[mesh, face, 2, k] - value)
                ga, gb, gc = ga * s * ia, gb * s * ib, gc * s * ic  # by the screen barycentrics
                gx = ga * by_x[0] + gb * by_x[1] + gc * by_x[2]
                gy = ga * by_y[0] + gb * by_y[1] + gc * by_y[2]
                grad_screen[view, a, 0] -= w[0] * gx
                grad_screen[view, a, 1] -= w[0] * gy
                grad_screen[view, b, 0] -= w[1] * gx
                grad_screen[view, b, 1] -= w[1] * gy
                grad_screen[view, c, 0] -= w[2] * gx
                grad_screen[view, c, 1] -= w[2] * gy
                grad_depth[view, a] -= ga * w[0] * ia
                grad_depth[view, b] -= gb * w[1] * ib
                grad_depth[view, c] -= gc * w[2] * ic
                if len(grad_attributes):
                    la, lb, lc = w[0] * ia * s, w[1] * ib * s, w[2] * ic * s
                    for k in range(channels):
                        slope = grad[row, k]
                        grad_attributes[mesh, face, 0, k] += slope * la
                        grad_attributes[mesh, face, 1, k] += slope * lb
                        grad_attributes[mesh, face, 2, k] += slope * lc
