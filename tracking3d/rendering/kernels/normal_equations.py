"""Kernel of `tracking3d.rendering.normal_equations`, and its part of a pose's terms: what covered pixels say."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
import torch
from numba import float32, float64, int64, types, void
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.rendering.kernels.compilation import (
    OPTIONS,
    REORDER,
    array,
    check_corners,
    kernel,
    record,
    share,
)
from tracking3d.rendering.kernels.interpolation import barycentrics, slopes_of_face
from tracking3d.rendering.kernels.texture_losses import bilinear_weights, taps_of, texels_at
from tracking3d.rendering.renderer import Rendering

COMPARABLE, KNOWN = 0, 1
"""Places of what is counted of pixels: see `PoseTerms`."""


class SurfaceArrays(NamedTuple):
    """An object as `tracking3d.rendering.surface.Surface` has it."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int64]
    face_uvs: NDArray[np.float32]
    edges: NDArray[np.int64]
    faces_of_edge: NDArray[np.int64]
    layers: NDArray[np.float32]


class TargetArrays(NamedTuple):
    """A frame as `PoseTarget` has it, features ``(S, S, C)``; what it does not have is empty."""

    features: NDArray[np.float32]
    comparable: NDArray[np.float32]
    inside: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    distance: NDArray[np.float32]
    K: NDArray[np.float32]


class DrawingBuffers(NamedTuple):
    """What `terms_of_pose` writes on its way, to be used again.

    Attributes:
        x_cam: ``(V, 3)`` vertices in the camera, and
        screen: ``(V, 2)`` on the screen.
        face_index: ``(S, S)`` faces, and
        inverse_depth: ``(S, S)`` of what is drawn.
    """

    x_cam: NDArray[np.float32]
    screen: NDArray[np.float32]
    face_index: NDArray[np.int64]
    inverse_depth: NDArray[np.float32]


SURFACE = record(
    SurfaceArrays,
    float32[:, ::1], int64[:, ::1], float32[:, :, ::1], int64[:, ::1], int64[::1], float32[:, :, ::1],
)  # fmt: skip


def equations_of_pixels(
    drawn: Rendering, observed: Tensor, pivot: Tensor, scale: float, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `tracking3d.rendering.pose_normal_equations`; ``observed`` is ``(B, H, W, C)``."""
    check_corners(drawn.faces, drawn.screen)
    shape = drawn.face_index.shape
    comparable = weight.new_zeros(drawn.face_index.numel()).index_copy(0, drawn.pixels, weight).reshape(shape)
    layers = torch.cat([drawn.texture, torch.ones_like(drawn.texture[:1])]).permute(1, 2, 0)
    none = np.empty((0, 0), np.int64)
    surface = SurfaceArrays(
        np.empty((0, 3), np.float32), array(drawn.faces), array(drawn.face_uvs), none, none.reshape(-1),
        array(layers),
    )  # fmt: skip
    views = observed, comparable, drawn.K, drawn.x_cam, drawn.screen, drawn.depth.reciprocal(), pivot
    sums = np.zeros((len(pivot), 7, 7))
    share(
        _equations_of_pixels,
        len(pivot),
        2,
        surface,
        array(drawn.face_index),
        tuple(map(array, views)),
        scale,
        sums,
    )
    found = torch.from_numpy(sums).to(drawn.screen)
    return found[:, :6, :6], found[:, 6, :6], found[:, 6, 6]


_PLANES, _ROWS = float32[:, :, ::1], float32[:, ::1]


@kernel(
    void(
        SURFACE, int64[:, :, ::1], types.Tuple((float32[:, :, :, ::1], *[_PLANES] * 5, _ROWS)), float64,
        float64[:, :, ::1], int64, int64,
    )
)  # fmt: skip
def _equations_of_pixels(surface, face_index, views, scale, sums, first, last):
    observed, comparable, K, x_cam, screen, inverse_depth, pivot = views
    nowhere, counts = np.empty((0, 0), np.bool_), np.zeros(4)
    for view in range(first, last):
        target = TargetArrays(observed[view], comparable[view], nowhere, nowhere, comparable[view], K[view])
        buffers = DrawingBuffers(x_cam[view], screen[view], face_index[view], inverse_depth[view])
        depth = np.ascontiguousarray(x_cam[view, :, 2])
        of_pixels(surface, target, buffers, depth, pivot[view], scale, sums[view], counts)


@numba.njit(fastmath=REORDER, **OPTIONS)
def of_pixels(surface, target, buffers, depth, pivot, scale, sums, counts):
    """Mean loss of the features over the covered pixels; see `tracking3d.rendering.normal_equations`."""
    faces, face_uvs, layers = surface.faces, surface.face_uvs, surface.layers
    features, comparable, K = target.features, target.comparable, target.K
    screen, face_index, inverse_depth = buffers.screen, buffers.face_index, buffers.inverse_depth
    height, width, channels = layers.shape[0], layers.shape[1], layers.shape[2] - 1
    rows, columns = face_index.shape
    one = np.float32(1)
    sharpness = np.float32(1 / scale**2)
    fx, cx, fy, cy = K[0, 0], K[0, 2], K[1, 1], K[1, 2]
    motion = np.zeros((2, 6), np.float32)
    total = 0.0
    for y in range(rows):
        x = 0
        while x < columns:
            face = face_index[y, x]
            if face < 0:
                x += 1
                continue
            a, b, c = faces[face]
            place, slope_x, slope_y, inverse = slopes_of_face(screen, depth, a, b, c)
            uv = face_uvs[face]
            while x < columns and face_index[y, x] == face:
                column = x
                x += 1
                counts[COMPARABLE] += comparable[y, column]
                if comparable[y, column] == 0:
                    continue
                wa, wb, wc = barycentrics(place, slope_x, slope_y, np.float32(column), np.float32(y))
                wa, wb, wc = wa * inverse[0], wb * inverse[1], wc * inverse[2]
                s = one / (wa + wb + wc)
                u = (wa * uv[0, 0] + wb * uv[1, 0] + wc * uv[2, 0]) * s
                v = (wa * uv[0, 1] + wb * uv[1, 1] + wc * uv[2, 1]) * s
                taps = taps_of(u, v, height, width)
                w00, w01, w10, w11 = bilinear_weights(taps)
                t00, t01, t10, t11 = texels_at(layers, taps)
                seen = w00 * t00[channels] + w01 * t01[channels] + w10 * t10[channels] + w11 * t11[channels]
                weight = np.float64(seen * comparable[y, column])
                if weight == 0:
                    continue
                total += weight
                ua, va, ub, vb = uv[0, 0] - u, uv[0, 1] - v, uv[1, 0] - u, uv[1, 1] - v
                uc, vc = uv[2, 0] - u, uv[2, 1] - v
                xa, xb, xc = slope_x[0] * inverse[0], slope_x[1] * inverse[1], slope_x[2] * inverse[2]
                ya, yb, yc = slope_y[0] * inverse[0], slope_y[1] * inverse[1], slope_y[2] * inverse[2]
                z = one / inverse_depth[y, column]
                texels_u, texels_v = z * np.float32(width), z * np.float32(height)
                by_x = (xa * ua + xb * ub + xc * uc) * texels_u, (xa * va + xb * vb + xc * vc) * texels_v
                by_y = (ya * ua + yb * ub + yc * uc) * texels_u, (ya * va + yb * vb + yc * vc) * texels_v
                xx, xy, yy, gx, gy, loss = of_channels(
                    layers, taps, features[y, column], channels, sharpness, by_x, by_y
                )
                ray_x, ray_y = (np.float32(column) - cx) / fx, (np.float32(y) - cy) / fy
                point_motion(ray_x, ray_y, z, fx, fy, pivot, motion)
                for i in range(6):
                    left_x = weight * (xx * motion[0, i] + xy * motion[1, i])
                    left_y = weight * (xy * motion[0, i] + yy * motion[1, i])
                    for j in range(i, 6):
                        sums[i, j] += left_x * motion[0, j] + left_y * motion[1, j]
                    # At a fixed pixel the rendered image moves against the surface.
                    sums[6, i] -= weight * (gx * motion[0, i] + gy * motion[1, i])
                sums[6, 6] += weight * loss
    counts[KNOWN] = total
    finish(sums, max(total, 1.0) * channels)


@numba.njit(inline="always", **OPTIONS)
def of_channels(texture, taps, target, channels, sharpness, by_x, by_y):
    """Terms of one pixel, summed over the channels: the 2 x 2 matrix, the two slopes of half the loss, and the loss.

    ``by_x`` and ``by_y`` are the derivatives of the place in the texture, in texels, by the pixel's x and y.
    """
    one = np.float32(1)
    _, _, _, _, fx, fy, free = taps
    w00, w01, w10, w11 = bilinear_weights(taps)
    t00, t01, t10, t11 = texels_at(texture, taps)
    down = one if free else np.float32(0)
    xx = xy = yy = x = y = np.float32(0)
    loss, product = 0.0, 1.0
    for c in range(channels):
        d = w00 * t00[c] + w01 * t01[c] + w10 * t10[c] + w11 * t11[c] - target[c]
        along_u = (one - fy) * (t01[c] - t00[c]) + fy * (t11[c] - t10[c])
        along_v = down * ((one - fx) * (t10[c] - t00[c]) + fx * (t11[c] - t01[c]))
        gx = along_u * by_x[0] + along_v * by_x[1]
        gy = along_u * by_y[0] + along_v * by_y[1]
        factor = one + d * d * sharpness
        robust = sharpness / factor
        xx += robust * gx * gx
        xy += robust * gx * gy
        yy += robust * gy * gy
        x += robust * gx * d
        y += robust * gy * d
        product *= np.float64(factor)
        if product > 1e200:
            loss += math.log(product)
            product = 1.0
    return xx, xy, yy, x, y, loss + math.log(product)


@numba.njit(inline="always", **OPTIONS)
def point_motion(ray_x, ray_y, z, fx, fy, pivot, motion):
    """Motion on the screen ``(2, 6)`` by (v, w) of the surface point at ``z`` times ``(ray_x, ray_y, 1)``."""
    px, py, pz = ray_x * z - pivot[0], ray_y * z - pivot[1], z - pivot[2]
    sx, sy = fx / z, fy / z
    motion[0, 0], motion[0, 2] = sx, -sx * ray_x
    motion[1, 1], motion[1, 2] = sy, -sy * ray_y
    motion[0, 3], motion[0, 4], motion[0, 5] = -sx * ray_x * py, sx * (pz + ray_x * px), -sx * py
    motion[1, 3], motion[1, 4], motion[1, 5] = -sy * (pz + ray_y * py), sy * ray_y * px, sy * px


@numba.njit(**OPTIONS)
def finish(sums, total):
    """Means of sums: the upper triangle and the gradient are halves of what they stand for."""
    for i in range(6):
        sums[6, i] *= 2 / total
        for j in range(i, 6):
            sums[i, j] *= 2 / total
            sums[j, i] = sums[i, j]
    sums[6, 6] /= total
