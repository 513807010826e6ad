"""Kernel of `tracking3d.rendering.backprojection`: what a frame shows of every texel, in one pass over the atlas."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
import torch
from numba import boolean, float32, int64
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.rendering.kernels.compilation import OPTIONS, array, kernel, record


class FrameArrays(NamedTuple):
    """A frame: ``values`` ``(C, H, W)``, where they are ``valid``, the mesh's depth ``drawn`` there, and ``K``."""

    values: NDArray[np.float32]
    valid: NDArray[np.float32]
    drawn: NDArray[np.float32]
    K: NDArray[np.float32]


class FaceArrays(NamedTuple):
    """Faces in camera coordinates: corners ``(F, 3, 3)``, normals ``(F, 3)``, and which may be seen ``(F,)``."""

    corners: NDArray[np.float32]
    normals: NDArray[np.float32]
    facing: NDArray[np.bool_]


class TexelArrays(NamedTuple):
    """Texels of an atlas: flat indices ``(M,)``, faces ``(M,)`` and barycentric coordinates ``(3, M)``."""

    texel: NDArray[np.int64]
    face: NDArray[np.int64]
    barycentric: NDArray[np.float32]


class SeenArrays(NamedTuple):
    """Memory for what is seen of texels: flat indices ``(M,)``, values ``(C, M)`` and weights ``(M,)``."""

    texel: NDArray[np.int64]
    values: NDArray[np.float32]
    weight: NDArray[np.float32]


_FRAME = record(FrameArrays, float32[:, :, ::1], float32[:, ::1], float32[:, ::1], float32[:, ::1])
_FACES = record(FaceArrays, float32[:, :, ::1], float32[:, ::1], boolean[::1])
_TEXELS = record(TexelArrays, int64[::1], int64[::1], float32[:, ::1])
_SEEN = record(SeenArrays, int64[::1], float32[:, ::1], float32[::1])


def seen_texels(
    values: Tensor,
    valid: Tensor,
    drawn: Tensor,
    corners: Tensor,
    normals: Tensor,
    facing: Tensor,
    texels: tuple[Tensor, Tensor, Tensor],
    K: Tensor,
    grazing: float,
    tolerance: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Indices ``(N,)``, values ``(C, N)`` and weights ``(N,)`` of `tracking3d.rendering.backprojection.SeenTexels`.

    Args:
        values: ``(C, H, W)``; valid: ``(H, W)``; K: ``(3, 3)``, see `tracking3d.rendering.seen_texels`.
        drawn: ``(H, W)`` depth of the mesh, infinite beside it.
        corners: ``(F, 3, 3)`` of the faces, in camera coordinates.
        normals: ``(F, 3)``; facing: ``(F,)`` bool, which of them may be seen.
        texels: Flat indices ``(M,)``, faces ``(M,)`` and barycentric coordinates ``(M, 3)``.
        grazing: Smallest cosine of the viewing angle that is believed.
        tolerance: By how much something may be nearer at a cosine of 1.
    """
    texel, face, barycentric = texels
    count, channels = len(texel), len(values)
    seen = SeenArrays(
        np.empty(count, np.int64), np.empty((channels, count), np.float32), np.empty(count, np.float32)
    )
    found = _seen_texels(
        FrameArrays(array(values), array(valid), array(drawn), array(K)),
        FaceArrays(array(corners), array(normals), array(facing)),
        TexelArrays(array(texel), array(face), array(barycentric.T)),
        grazing,
        tolerance,
        seen,
    )
    index, shown, weight = (torch.from_numpy(one) for one in seen)
    return index[:found], shown[:, :found], weight[:found]


@numba.njit(inline="always", **OPTIONS)
def _sampled(plane, column, row, right, down):
    """Bilinear, with nothing beyond the border."""
    height, width = plane.shape
    one, total = np.float32(1), np.float32(0)
    for dy in range(2):
        for dx in range(2):
            if 0 <= row + dy < height and 0 <= column + dx < width:
                share = (right if dx else one - right) * (down if dy else one - down)
                total += share * plane[row + dy, column + dx]
    return total


@kernel(int64(_FRAME, _FACES, _TEXELS, float32, float32, _SEEN))
def _seen_texels(frame, faces, texels, grazing, tolerance, seen):
    """Fill ``seen``, and return how many texels are."""
    values, valid, drawn, K = frame
    corners, normals, facing = faces
    texel, face_of, barycentric = texels
    index, shown, weight = seen
    height, width = valid.shape
    found = 0
    for one in range(len(texel)):
        face = face_of[one]
        if not facing[face]:
            continue
        a, b, c = barycentric[0, one], barycentric[1, one], barycentric[2, one]
        corner, normal = corners[face], normals[face]
        x = a * corner[0, 0] + b * corner[1, 0] + c * corner[2, 0]
        y = a * corner[0, 1] + b * corner[1, 1] + c * corner[2, 1]
        z = a * corner[0, 2] + b * corner[1, 2] + c * corner[2, 2]
        cosine = -(normal[0] * x + normal[1] * y + normal[2] * z) / np.sqrt(x * x + y * y + z * z)
        if not (cosine > grazing and z > 0):
            continue
        u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        if not (-0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5):
            continue
        column, row = min(max(round(u), 0), width - 1), min(max(round(v), 0), height - 1)
        nearest = drawn[row, column]
        if not (0 < nearest < np.inf and z < nearest + tolerance / cosine):
            continue
        column, row = math.floor(u), math.floor(v)
        right, down = u - np.float32(column), v - np.float32(row)
        believed = cosine * cosine * _sampled(valid, column, row, right, down)
        if not believed > 0:
            continue
        index[found], weight[found] = texel[one], believed
        for channel in range(len(values)):
            shown[channel, found] = _sampled(values[channel], column, row, right, down)
        found += 1
    return found
