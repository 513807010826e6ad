"""Kernel of `tracking3d.rendering.normal_equations`."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
import torch
from numba import float32, float64, int64, void
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
from tracking3d.rendering.kernels.interpolation import slopes_of_face
from tracking3d.rendering.kernels.texture_losses import bilinear_weights, taps_of, texels_at
from tracking3d.rendering.renderer import Rendering


class RenderingArrays(NamedTuple):
    """What was drawn, as `Rendering` has it; ``ends`` ``(B + 1,)`` are where the pixels of every view begin and end."""

    screen: NDArray[np.float32]
    depth: NDArray[np.float32]
    faces: NDArray[np.int64]
    face_uvs: NDArray[np.float32]
    face_index: NDArray[np.int64]
    drawn: NDArray[np.float32]
    texture: NDArray[np.float32]
    pixels: NDArray[np.int64]
    ends: NDArray[np.int64]
    uv: NDArray[np.float32]
    K: NDArray[np.float32]


_RENDERING = record(
    RenderingArrays,
    float32[:, :, ::1], float32[:, ::1], int64[:, ::1], float32[:, :, ::1], int64[:, :, ::1], float32[:, :, ::1],
    float32[:, :, ::1], int64[::1], int64[::1], float32[:, ::1], float32[:, :, ::1],
)  # fmt: skip


def accumulate(
    drawn: Rendering, observed: Tensor, pivot: Tensor, scale: float, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Matrix ``(B, 6, 6)``, gradient ``(B, 6)`` and cost ``(B,)``, see `pose_normal_equations`.

    Args:
        drawn: The rendering.
        observed: ``(N, C)`` features of all pixels of the frames.
        pivot: ``(B, 3)``; scale: of the loss; weight: ``(P,)``.
    """
    check_corners(drawn.faces, drawn.screen)
    texture = array(drawn.texture.permute(1, 2, 0))
    pixels, (batch, height, width) = array(drawn.pixels), drawn.face_index.shape
    ends = np.searchsorted(pixels, np.arange(batch + 1) * height * width)
    arrays = RenderingArrays(
        array(drawn.screen),
        array(drawn.x_cam[..., 2]),
        array(drawn.faces),
        array(drawn.face_uvs),
        array(drawn.face_index),
        array(drawn.depth),
        texture,
        pixels,
        ends,
        array(drawn.uv),
        array(drawn.K),
    )
    sums = np.zeros((batch, 7, 7))
    share(_accumulate, batch, 2, arrays, *map(array, (pivot, observed, weight)), scale, sums)
    result = torch.from_numpy(sums).to(drawn.uv)
    return result[:, :6, :6], result[:, 6, :6], result[:, 6, 6]


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


@kernel(
    void(
        _RENDERING, float32[:, ::1], float32[:, ::1], float32[::1], float64, float64[:, :, ::1], int64, int64
    ),
    fastmath=REORDER,
)
def _accumulate(rendering, pivot, observed, weight, scale, sums, first, last):
    """Sums of each view: the matrix, and in the last row the gradient and the cost."""
    screen, depth, faces, face_uvs, face_index, drawn, texture, pixels, ends, uv, K = rendering
    height, width, channels = texture.shape
    sharpness = np.float32(1 / scale**2)
    rows, columns = face_index.shape[1:]
    motion = np.zeros((2, 6), np.float32)  # of the surface point on the screen
    for view in range(first, last):
        total = 0.0
        for place in range(ends[view], ends[view + 1]):
            total += weight[place]
        fx, cx, fy, cy = K[view, 0, 0], K[view, 0, 2], K[view, 1, 1], K[view, 1, 2]
        matrix = sums[view]
        for place in range(ends[view], ends[view + 1]):
            if weight[place] == 0:
                continue
            pixel = pixels[place] - view * rows * columns
            y, x = pixel // columns, pixel % columns
            face, z = face_index[view, y, x], drawn[view, y, x]
            a, b, c = faces[face]
            _, slope_x, slope_y, inverse = slopes_of_face(screen[view], depth[view], a, b, c)
            u, v = uv[place]
            ua, va = face_uvs[face, 0, 0] - u, face_uvs[face, 0, 1] - v
            ub, vb = face_uvs[face, 1, 0] - u, face_uvs[face, 1, 1] - v
            uc, vc = face_uvs[face, 2, 0] - u, face_uvs[face, 2, 1] - v
            xa, xb, xc = slope_x[0] * inverse[0], slope_x[1] * inverse[1], slope_x[2] * inverse[2]
            ya, yb, yc = slope_y[0] * inverse[0], slope_y[1] * inverse[1], slope_y[2] * inverse[2]
            texels_u, texels_v = z * np.float32(width), z * np.float32(height)
            by_x = (xa * ua + xb * ub + xc * uc) * texels_u, (xa * va + xb * vb + xc * vc) * texels_v
            by_y = (ya * ua + yb * ub + yc * uc) * texels_u, (ya * va + yb * vb + yc * vc) * texels_v
            taps = taps_of(u, v, height, width)
            xx, xy, yy, gx, gy, loss = of_channels(
                texture, taps, observed[pixels[place]], channels, sharpness, by_x, by_y
            )
            # Half the loss has these; two in front of everything makes it the loss.
            share_of_pixel = weight[place] / max(total, 1.0) / channels
            ray_x, ray_y = (np.float32(x) - cx) / fx, (np.float32(y) - cy) / fy
            point_motion(ray_x, ray_y, z, fx, fy, pivot[view], motion)
            for i in range(6):
                left_x = 2 * share_of_pixel * (xx * motion[0, i] + xy * motion[1, i])
                left_y = 2 * share_of_pixel * (xy * motion[0, i] + yy * motion[1, i])
                for j in range(6):
                    matrix[i, j] += left_x * motion[0, j] + left_y * motion[1, j]
                matrix[6, i] -= 2 * share_of_pixel * (gx * motion[0, i] + gy * motion[1, i])
            matrix[6, 6] += share_of_pixel * loss
