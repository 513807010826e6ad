"""Kernels of `tracking3d.rendering.interpolation`; the backward pass computes the barycentrics again.

Neighbours in a row mostly show the same face: what depends on the face only is computed once for such a run, and
its gradients are summed up before they are added to the vertices.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numba import float32, int64, void
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from tracking3d.rendering.kernels.compilation import (
    OPTIONS,
    REORDER,
    array,
    check_corners,
    kernel,
    record,
    share,
)


class AttributeArrays(NamedTuple):
    """What is interpolated: the inputs of `Interpolate`, and where the rows of every view begin and end."""

    screen: NDArray[np.float32]
    depth: NDArray[np.float32]
    faces: NDArray[np.int64]
    attributes: NDArray[np.float32]
    face_index: NDArray[np.int64]
    ends: NDArray[np.int64]


class AttributeGradients(NamedTuple):
    """Sums of gradients by the inputs, written to; those by attributes are empty if nobody wants them."""

    screen: NDArray[np.float32]
    depth: NDArray[np.float32]
    attributes: NDArray[np.float32]


_ATTRIBUTES = record(
    AttributeArrays,
    float32[:, :, ::1], float32[:, ::1], int64[:, ::1], float32[:, :, :, ::1], int64[:, :, ::1], int64[::1],
)  # fmt: skip
_GRADIENTS = record(AttributeGradients, float32[:, :, ::1], float32[:, ::1], float32[:, :, :, ::1])


class Interpolate(torch.autograd.Function):
    """``(P, D)`` from screen, depth, faces, attributes, face_index, as in the module of the same name.

    ``attributes`` is ``(M, F, 3, D)``, with M = 1 for all views or M = B.
    """

    @staticmethod
    def forward(
        ctx: Any, screen: Tensor, depth: Tensor, faces: Tensor, attributes: Tensor, face_index: Tensor
    ) -> Tensor:
        check_corners(faces, screen)
        index = array(face_index)
        ends = np.empty(len(index) + 1, dtype=np.int64)
        if _count(index, ends) >= len(faces):
            raise IndexError(f"face_index names face {int(index.max())}, but there are {len(faces)} faces")
        values = torch.empty(int(ends[-1]), attributes.shape[3], dtype=torch.float32)
        arrays = AttributeArrays(array(screen), array(depth), array(faces), array(attributes), index, ends)
        share(_forward, len(index), 2, arrays, values.numpy())
        ctx.save_for_backward(screen, depth, faces, attributes, face_index, values)
        ctx.ends = ends
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        screen, depth, faces, attributes, face_index, values = ctx.saved_tensors
        grads = [torch.zeros(part.shape, dtype=torch.float32) for part in (screen, depth)]
        wanted = ctx.needs_input_grad[3]
        grad_attributes = torch.zeros(attributes.shape if wanted else (0, 0, 0, 0), dtype=torch.float32)
        arrays = AttributeArrays(
            array(screen), array(depth), array(faces), array(attributes), array(face_index), ctx.ends
        )
        # Views that share their attributes would add to the same places.
        views, least = len(screen), 10**9 if wanted and len(attributes) == 1 else 2
        outputs = AttributeGradients(*(part.numpy() for part in (*grads, grad_attributes)))
        share(_backward, views, least, arrays, array(values), array(grad), outputs)
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
def slopes_of_face(corners, z, a, b, c):
    """Slopes of the screen barycentrics by x and by y, and of their sums over the depths; inverse depths."""
    ax, ay, bx, by, cx, cy = (
        corners[a, 0], corners[a, 1], corners[b, 0], corners[b, 1], corners[c, 0], corners[c, 1]
    )  # fmt: skip
    one = np.float32(1)
    scale = one / ((ax - cx) * (by - ay) - (ay - cy) * (bx - ax))
    by_x = (by - cy) * scale, (cy - ay) * scale, (ay - by) * scale
    by_y = (cx - bx) * scale, (ax - cx) * scale, (bx - ax) * scale
    return (ax, ay, bx, by, cx, cy), by_x, by_y, (one / z[a], one / z[b], one / z[c])


@numba.njit(inline="always", **OPTIONS)
def barycentrics(place, by_x, by_y, x, y):
    """Screen barycentrics of a pixel, each measured from the corner that follows."""
    ax, ay, bx, by, cx, cy = place
    return (
        (x - bx) * by_x[0] + (y - by) * by_y[0],
        (x - cx) * by_x[1] + (y - cy) * by_y[1],
        (x - ax) * by_x[2] + (y - ay) * by_y[2],
    )


@numba.njit(inline="always", **OPTIONS)
def _mix(attributes, mesh, face, wa, wb, wc, values, row, channels):
    for k in range(channels):
        values[row, k] = (
            wa * attributes[mesh, face, 0, k]
            + wb * attributes[mesh, face, 1, k]
            + wc * attributes[mesh, face, 2, k]
        )


@kernel(void(_ATTRIBUTES, float32[:, ::1], int64, int64), fastmath=REORDER)
def _forward(arrays, values, first, last):
    screen, depth, faces, attributes, face_index, ends = arrays
    height, width = face_index.shape[1:]
    channels = attributes.shape[3]
    for view in range(first, last):
        mesh = view if len(attributes) > 1 else 0
        row = ends[view]
        for y in range(height):
            x = 0
            while x < width:
                face = face_index[view, y, x]
                if face < 0:
                    x += 1
                    continue
                place, by_x, by_y, inverse = slopes_of_face(
                    screen[view], depth[view], faces[face, 0], faces[face, 1], faces[face, 2]
                )
                while x < width and face_index[view, y, x] == face:
                    w = barycentrics(place, by_x, by_y, np.float32(x), np.float32(y))
                    wa, wb, wc = w[0] * inverse[0], w[1] * inverse[1], w[2] * inverse[2]
                    s = np.float32(1) / (wa + wb + wc)
                    if channels == 2:  # texture coordinates: a loop of known length is not a loop any more
                        _mix(attributes, mesh, face, wa * s, wb * s, wc * s, values, row, 2)
                    else:
                        _mix(attributes, mesh, face, wa * s, wb * s, wc * s, values, row, channels)
                    row += 1
                    x += 1


@numba.njit(inline="always", **OPTIONS)
def _differences(attributes, mesh, face, values, grad, row, channels):
    """For each corner ``sum_k dL/du_k (u_k of the corner - u_k)``."""
    ga, gb, gc = np.float32(0), np.float32(0), np.float32(0)
    for k in range(channels):
        value, slope = values[row, k], grad[row, k]
        ga += slope * (attributes[mesh, face, 0, k] - value)
        gb += slope * (attributes[mesh, face, 1, k] - value)
        gc += slope * (attributes[mesh, face, 2, k] - value)
    return ga, gb, gc


@kernel(
    void(_ATTRIBUTES, float32[:, ::1], float32[:, ::1], _GRADIENTS, int64, int64),
    fastmath=REORDER,
)
def _backward(arrays, values, grad, gradients, first, last):
    screen, depth, faces, attributes, face_index, ends = arrays
    grad_screen, grad_depth, grad_attributes = gradients
    height, width = face_index.shape[1:]
    channels = attributes.shape[3]
    for view in range(first, last):
        mesh = view if len(attributes) > 1 else 0
        by_corner, by_z = grad_screen[view], grad_depth[view]
        row = ends[view]
        for y in range(height):
            x = 0
            while x < width:
                face = face_index[view, y, x]
                if face < 0:
                    x += 1
                    continue
                a, b, c = faces[face]
                place, by_x, by_y, inverse = slopes_of_face(screen[view], depth[view], a, b, c)
                ax = ay = bx = by = cx = cy = az = bz = cz = np.float32(0)
                while x < width and face_index[view, y, x] == face:
                    w = barycentrics(place, by_x, by_y, np.float32(x), np.float32(y))
                    wa, wb, wc = w[0] * inverse[0], w[1] * inverse[1], w[2] * inverse[2]
                    s = np.float32(1) / (wa + wb + wc)
                    if channels == 2:
                        ga, gb, gc = _differences(attributes, mesh, face, values, grad, row, 2)
                    else:
                        ga, gb, gc = _differences(attributes, mesh, face, values, grad, row, channels)
                    ga, gb, gc = ga * s, gb * s, gc * s
                    az += ga * wa
                    bz += gb * wb
                    cz += gc * wc
                    ga, gb, gc = ga * inverse[0], gb * inverse[1], gc * inverse[2]  # by the barycentrics
                    gx = ga * by_x[0] + gb * by_x[1] + gc * by_x[2]
                    gy = ga * by_y[0] + gb * by_y[1] + gc * by_y[2]
                    ax += w[0] * gx
                    ay += w[0] * gy
                    bx += w[1] * gx
                    by += w[1] * gy
                    cx += w[2] * gx
                    cy += w[2] * gy
                    if len(grad_attributes):
                        for k in range(channels):
                            slope = grad[row, k] * s
                            grad_attributes[mesh, face, 0, k] += slope * wa
                            grad_attributes[mesh, face, 1, k] += slope * wb
                            grad_attributes[mesh, face, 2, k] += slope * wc
                    row += 1
                    x += 1
                by_corner[a, 0] -= ax
                by_corner[a, 1] -= ay
                by_corner[b, 0] -= bx
                by_corner[b, 1] -= by
                by_corner[c, 0] -= cx
                by_corner[c, 1] -= cy
                by_z[a] -= az * inverse[0]
                by_z[b] -= bz * inverse[1]
                by_z[c] -= cz * inverse[2]
