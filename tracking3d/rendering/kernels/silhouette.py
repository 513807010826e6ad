"""Kernels of `tracking3d.rendering.silhouette`.

Faces are taken in index order, so that a count at each pixel tells the first ``knum``. What the backward pass needs
of every pair of a face and a pixel is kept, as in the torch implementation.
"""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numba import float32, float64, int32, int64, void
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

_TINY = np.finfo(np.float32).tiny


class PairArrays(NamedTuple):
    """Pairs of a face and a pixel that it is near to."""

    counts: NDArray[np.int64]  # (B, 2) of boxes and of pairs in each view
    ends: NDArray[np.int64]  # (B + 1,) where the memory for the pairs of every view begins and ends
    places: NDArray[np.int32]  # (M, 3) the pixel, and the nearest edge's two corners
    slopes: NDArray[np.float32]  # (M, 3) t, the nearest place on the edge, and factor r


_PAIRS = record(PairArrays, int64[:, ::1], int64[::1], int32[:, ::1], float32[:, ::1])


class SoftSilhouette(torch.autograd.Function):
    """``(B, H, W)`` from screen, depth, faces, face_index and near, sigma, boxlen, knum, epsilon."""

    @staticmethod
    def forward(
        ctx: Any,
        screen: Tensor,
        depth: Tensor,
        faces: Tensor,
        face_index: Tensor,
        near: float,
        sigma: float,
        boxlen: float,
        knum: int,
        epsilon: float,
    ) -> Tensor:
        check_corners(faces, screen)
        views = len(screen)
        corners, index = array(screen), array(face_index)
        boxes = np.empty((views, len(faces), 5), np.int32)
        counts = np.empty((views, 2), np.int64)  # of boxes and of pairs in each view, at most
        rest, silhouette = (
            torch.empty(face_index.shape, dtype=torch.float32),
            torch.empty(face_index.shape, dtype=torch.float32),
        )
        arrays = corners, array(depth), array(faces)
        share(_boxes, views, 2, *arrays, index, near, boxlen, knum, rest.numpy(), boxes, counts)
        ends = np.concatenate([np.zeros(1, np.int64), counts[:, 1].cumsum()])
        places = np.empty((int(ends[-1]), 3), np.int32)
        slopes = np.empty((int(ends[-1]), 3), np.float32)
        pairs = PairArrays(counts, ends, places, slopes)
        band = sigma, knum, epsilon
        share(_pairs, views, 2, corners, array(faces), boxes, *band, rest.numpy(), silhouette.numpy(), pairs)
        ctx.shape, ctx.pairs = screen.shape, (pairs, rest.numpy())
        return silhouette

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        grad_screen = torch.zeros(ctx.shape, dtype=torch.float32)
        share(_backward, len(grad_screen), 2, array(grad), *ctx.pairs, grad_screen.numpy())
        return (grad_screen, *[None] * 8)


@numba.njit(inline="always", **OPTIONS)
def _bounds(low, high, boxlen, side):
    """Pixels ``first <= i < end`` of a box that is grown by ``boxlen``; all in NDC."""
    one, two, extent = np.float32(1), np.float32(2), np.float32(side)
    first = np.ceil(((low - boxlen + one) * extent - one) / two)
    end = np.ceil(((high + boxlen + one) * extent - one) / two)
    return min(max(first, np.float32(0)), extent), min(max(end, np.float32(0)), extent)


@numba.njit(inline="always", **OPTIONS)
def _ndc(position, side):
    return (np.float32(2) * position + np.float32(1 - side)) / np.float32(side)


@numba.njit(inline="always", **OPTIONS)
def _corners_of(screen, faces, face, width, height):
    a, b, c = faces[face]
    return (
        _ndc(screen[a, 0], width), _ndc(screen[a, 1], height), _ndc(screen[b, 0], width),
        _ndc(screen[b, 1], height), _ndc(screen[c, 0], width), _ndc(screen[c, 1], height),
    )  # fmt: skip


@kernel(
    "void(float32[:,:,::1], float32[:,::1], int64[:,::1], int64[:,:,::1], float64, float64, int64,"
    " float32[:,:,::1], int32[:,:,::1], int64[:,::1], int64, int64)"
)
def _boxes(screen, depth, faces, face_index, near, boxlen, knum, rest, boxes, counts, first, last):
    """Faces whose grown box holds an uncovered pixel, with the box: x0, x1, y0, y1, in order.

    ``rest`` becomes 1 at uncovered pixels and 0 at covered ones.
    """
    height, width = face_index.shape[1:]
    grown, plane = np.float32(boxlen), np.float32(near)
    before = np.zeros((height + 1, width + 1), np.int32)
    for view in range(first, last):
        z, index, product = depth[view], face_index[view], rest[view]
        # A vertex that is not finite shows: its view is NaN where it is uncovered.
        start = np.float32(1)
        for vertex in range(screen.shape[1]):
            if not (math.isfinite(screen[view, vertex, 0]) and math.isfinite(screen[view, vertex, 1])):
                start = np.float32(np.nan)
        for y in range(height):
            line = 0
            for x in range(width):
                uncovered = index[y, x] < 0
                line += uncovered
                before[y + 1, x + 1] = before[y, x + 1] + line
                product[y, x] = start if uncovered else np.float32(0)
        found, pairs = 0, 0
        for face in range(len(faces)):
            if not (z[faces[face, 0]] > plane and z[faces[face, 1]] > plane and z[faces[face, 2]] > plane):
                continue
            ax, ay, bx, by, cx, cy = _corners_of(screen[view], faces, face, width, height)
            left, right = _bounds(min(ax, bx, cx), max(ax, bx, cx), grown, width)
            top, bottom = _bounds(min(ay, by, cy), max(ay, by, cy), grown, height)
            if not (left < right and top < bottom):
                continue
            x0, x1, y0, y1 = int(left), int(right), int(top), int(bottom)
            # Most boxes hold no uncovered pixel: an integral image tells at once.
            uncovered = before[y1, x1] - before[y0, x1] - before[y1, x0] + before[y0, x0]
            if uncovered > 0:
                box = boxes[view, found]
                box[0], box[1], box[2], box[3], box[4] = face, x0, x1, y0, y1
                found += 1
                pairs += uncovered
        counts[view, 0], counts[view, 1] = found, min(pairs, min(knum, pairs) * before[height, width])


@numba.njit(inline="always", **OPTIONS)
def _nearest(px, py, ax, ay, ex, ey, inverse_length2):
    """Place on the edge nearest to a point, as a share of the edge, the way there and its squared length."""
    dx, dy = px - ax, py - ay
    t = min(max((dx * ex + dy * ey) * inverse_length2, np.float32(0)), np.float32(1))
    rx, ry = dx - t * ex, dy - t * ey
    return t, rx, ry, rx * rx + ry * ry


@kernel(
    void(
        float32[:, :, ::1], int64[:, ::1], int32[:, :, ::1], float64, int64, float64, float32[:, :, ::1],
        float32[:, :, ::1], _PAIRS, int64, int64,
    ),
    fastmath=REORDER,
)  # fmt: skip
def _pairs(screen, faces, boxes, sigma, knum, epsilon, rest, silhouette, pairs, first, last):
    """``1 - S`` and the silhouette, and of each pair what the backward pass needs.

    The factor is such that ``factor r (1 - S) dL/dS`` is the gradient by the nearest point of the edge.
    """
    counts, ends, places, slopes = pairs
    height, width = rest.shape[1:]
    sharpness, small = np.float32(sigma), np.float32(epsilon)
    one, two = np.float32(1), np.float32(2)
    count = np.empty(height * width, np.int32)
    for view in range(first, last):
        product, drawn = rest[view].reshape(-1), silhouette[view].reshape(-1)
        count[:] = 0
        pair = ends[view]
        for position in range(counts[view, 0]):
            face, x0, x1, y0, y1 = boxes[view, position]
            a, b, c = faces[face]
            ax, ay, bx, by, cx, cy = _corners_of(screen[view], faces, face, width, height)
            abx, aby, bcx, bcy, cax, cay = bx - ax, by - ay, cx - bx, cy - by, ax - cx, ay - cy
            ab = one / max(abx * abx + aby * aby, _TINY)
            bc = one / max(bcx * bcx + bcy * bcy, _TINY)
            ca = one / max(cax * cax + cay * cay, _TINY)
            for y in range(y0, y1):
                py = _ndc(np.float32(y), height)
                for x in range(x0, x1):
                    pixel = y * width + x
                    if product[pixel] == 0 or count[pixel] >= knum:
                        continue
                    count[pixel] += 1
                    px = _ndc(np.float32(x), width)
                    # Selections instead of branches, which nobody can predict here.
                    t, rx, ry, d2 = _nearest(px, py, ax, ay, abx, aby, ab)
                    t1, rx1, ry1, d21 = _nearest(px, py, bx, by, bcx, bcy, bc)
                    t2, rx2, ry2, d22 = _nearest(px, py, cx, cy, cax, cay, ca)
                    second = d21 < d2
                    t, rx, ry = t1 if second else t, rx1 if second else rx, ry1 if second else ry
                    d2 = d21 if second else d2
                    third = d22 < d2
                    t, rx, ry = t2 if third else t, rx2 if third else rx, ry2 if third else ry
                    d2 = d22 if third else d2
                    begin = c if third else (b if second else a)
                    end = a if third else (c if second else b)
                    e = np.float32(math.exp(-sharpness * d2))
                    product[pixel] *= one - e
                    factor = two * sharpness * e / (one - e + small)
                    places[pair, 0], places[pair, 1], places[pair, 2] = pixel, begin, end
                    slopes[pair, 0], slopes[pair, 1], slopes[pair, 2] = t, factor * rx, factor * ry
                    pair += 1
        counts[view, 1] = pair - ends[view]
        for pixel in range(height * width):
            drawn[pixel] = one - product[pixel]


@kernel(void(float32[:, :, ::1], _PAIRS, float32[:, :, ::1], float32[:, :, ::1], int64, int64))
def _backward(grad, pairs, rest, grad_screen, first, last):
    counts, ends, places, slopes = pairs
    height, width = grad.shape[1:]
    scale_x, scale_y = np.float32(2) / np.float32(width), np.float32(2) / np.float32(height)
    for view in range(first, last):
        grads, product, out = grad[view].reshape(-1), rest[view].reshape(-1), grad_screen[view]
        for pair in range(ends[view], ends[view] + counts[view, 1]):
            pixel, begin, end = places[pair]
            weight = grads[pixel] * product[pixel]
            # d(d2)/da = -2 (1 - t) r and d(d2)/db = -2 t r for the nearest point a + t (b - a).
            t = slopes[pair, 0]
            gx, gy = weight * slopes[pair, 1] * scale_x, weight * slopes[pair, 2] * scale_y
            out[begin, 0] += (np.float32(1) - t) * gx
            out[begin, 1] += (np.float32(1) - t) * gy
            out[end, 0] += t * gx
            out[end, 1] += t * gy
