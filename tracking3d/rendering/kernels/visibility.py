"""Kernel of `tracking3d.rendering.visibility`: the same arithmetic, bit for bit."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from torch import Tensor

from tracking3d.rendering.kernels.compilation import OPTIONS, array, check_corners, kernel, share


def rasterize(
    screen: Tensor, depth: Tensor, faces: Tensor, size: tuple[int, int], near: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Face index and depth ``(B, H, W)`` of the nearest front faces, and the covered pixels.

    Args:
        screen: ``(B, V, 2)``; depth: ``(B, V)``; faces: ``(F, 3)``; size: ``(H, W)``, see
            `tracking3d.rendering.rasterize`.
        near: Faces with a vertex nearer than this are not drawn.
    """
    check_corners(faces, screen)
    shape = (len(screen), *size)
    face_index = torch.full(shape, -1)
    drawn = torch.zeros(shape, dtype=torch.float32)
    arrays = array(screen), array(depth), array(faces)
    listed, counts = np.empty((shape[0], size[0] * size[1] + 1), np.int64), np.zeros(shape[0], np.int64)
    outputs = face_index.numpy(), drawn.numpy(), listed, counts
    share(_rasterize, len(screen), 2, *arrays, near, *outputs)
    covered = [line[:count] for line, count in zip(listed, counts, strict=True)]
    pixels = torch.from_numpy(np.concatenate(covered)) if covered else torch.empty(0, dtype=torch.int64)
    return face_index, drawn, pixels


def nearest_depth(screen: Tensor, depth: Tensor, faces: Tensor, size: tuple[int, int], near: float) -> Tensor:
    """``(H, W)``, see `tracking3d.rendering.visibility.nearest_depth`."""
    check_corners(faces, screen[None])
    drawn = np.zeros(size, np.float32)
    _nearest_depth(array(screen), array(depth), array(faces), near, np.empty(size, np.int32), drawn)
    return torch.from_numpy(drawn)


@numba.njit(inline="always", **OPTIONS)
def _edge(corners, start, end):
    """Where an edge begins, and its direction; it begins at its end of lower index, whichever face asks."""
    first = min(start, end)
    return (
        corners[first, 0],
        corners[first, 1],
        corners[start, 0] - corners[end, 0],
        corners[start, 1] - corners[end, 1],
    )


@numba.njit(**OPTIONS)
def draw_view(corners, z, faces, plane, winner, nearest):
    """The nearest front face of every pixel and its inverse depth, into -1 and 0."""
    height, width = winner.shape
    one = np.float32(1)
    for face in range(len(faces)):
        a, b, c = faces[face]
        za, zb, zc = z[a], z[b], z[c]
        if not (za > plane and zb > plane and zc > plane):
            continue
        ax, ay, bx, by, cx, cy = (
            corners[a, 0], corners[a, 1], corners[b, 0], corners[b, 1], corners[c, 0], corners[c, 1]
        )  # fmt: skip
        area = (by - ay) * (cx - ax) - (bx - ax) * (cy - ay)
        if not 0 < area < np.inf:
            continue
        x0 = math.ceil(min(max(min(ax, bx, cx), np.float32(0)), np.float32(width)))
        y0 = math.ceil(min(max(min(ay, by, cy), np.float32(0)), np.float32(height)))
        x1 = math.floor(max(min(max(ax, bx, cx), np.float32(width - 1)), np.float32(-1)))
        y1 = math.floor(max(min(max(ay, by, cy), np.float32(height - 1)), np.float32(-1)))
        if x0 > x1 or y0 > y1:
            continue
        by_a, by_b, by_c = (
            (one / za) * (one / area), (one / zb) * (one / area), (one / zc) * (one / area)
        )  # fmt: skip
        oxa, oya, exa, eya = _edge(corners, b, c)
        oxb, oyb, exb, eyb = _edge(corners, c, a)
        oxc, oyc, exc, eyc = _edge(corners, a, b)
        for y in range(y0, y1 + 1):
            fy = np.float32(y)
            along_a, along_b, along_c = exa * (fy - oya), exb * (fy - oyb), exc * (fy - oyc)
            entered = False
            for x in range(x0, x1 + 1):
                fx = np.float32(x)
                wa = along_a - eya * (fx - oxa)
                wb = along_b - eyb * (fx - oxb)
                wc = along_c - eyc * (fx - oxc)
                if min(wa, wb, wc) >= 0:
                    inverse_depth = wa * by_a + wb * by_b + wc * by_c
                    if inverse_depth > nearest[y, x]:
                        nearest[y, x] = inverse_depth
                        winner[y, x] = face
                    entered = True
                elif entered:
                    break  # a triangle is left once only


@kernel(
    "void(float32[:,:,::1], float32[:,::1], int64[:,::1], float64,"
    " int64[:,:,::1], float32[:,:,::1], int64[:,::1], int64[::1], int64, int64)"
)
def _rasterize(screen, depth, faces, near, face_index, drawn, listed, counts, first, last):
    height, width = face_index.shape[1:]
    one = np.float32(1)
    for view in range(first, last):
        nearest = drawn[view]  # inverse depths until the end
        draw_view(screen[view], depth[view], faces, np.float32(near), face_index[view], nearest)
        # Without branches: the place after the last one is written again and again.
        flat, line = nearest.reshape(-1), listed[view]
        covered = 0
        for pixel in range(height * width):
            line[covered] = view * height * width + pixel
            covered += flat[pixel] > 0
        counts[view] = covered
        for pixel in range(height * width):
            flat[pixel] = one / flat[pixel]


@kernel("void(float32[:,::1], float32[::1], int64[:,::1], float64, int32[:,::1], float32[:,::1])")
def _nearest_depth(screen, depth, faces, near, winner, drawn):
    draw_view(screen, depth, faces, np.float32(near), winner, drawn)
    flat, one = drawn.reshape(-1), np.float32(1)
    for pixel in range(flat.size):
        flat[pixel] = one / flat[pixel]
