"""Depth from patches along the known motion; `tracking3d.reconstruction.depth_maps` says what is computed."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from math import sqrt
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32, float64, int64, void
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, REORDER, kernel, record


class ReferenceView(NamedTuple):
    """The view whose depth is asked for: grey values and what is above 0.5 on the object ``(S, S)``, and ``(3, 3)``."""

    image: NDArray[np.float32]
    inside: NDArray[np.float32]
    K_inverse: NDArray[np.float64]


class OtherViews(NamedTuple):
    """Grey values ``(M, S, S)``, and ``(M, 3, 4)`` from camera coordinates of the view to their pixels."""

    images: NDArray[np.float32]
    P: NDArray[np.float64]


class SweptPatches(NamedTuple):
    """Patches: row and column ``(N, 2)``, depth ``(N,)`` and normal ``(N, 3)``; offsets that are tried ``(D,)``."""

    pixels: NDArray[np.int64]
    depth: NDArray[np.float64]
    normal: NDArray[np.float64]
    offsets: NDArray[np.float64]


_REFERENCE = record(ReferenceView, float32[:, ::1], float32[:, ::1], float64[:, ::1])
_OTHERS = record(OtherViews, float32[:, :, ::1], float64[:, :, ::1])
_PATCHES = record(SweptPatches, int64[:, ::1], float64[::1], float64[:, ::1], float64[::1])

_inner = numba.njit(fastmath=REORDER, **OPTIONS)


@kernel(
    void(_REFERENCE, _OTHERS, _PATCHES, int64, float64, int64, float32[:, ::1], float32[::1]),
    fastmath=REORDER,
)
def sweep(
    reference: ReferenceView,
    others: OtherViews,
    patches: SweptPatches,
    radius: int,
    least_contrast: float,
    agreeing: int,
    scores: NDArray[Any],
    contrast: NDArray[Any],
) -> None:
    """Fill ``scores`` (N, D): agreement of each pixel's patch with the other views at each depth; -1 where unknown."""
    image, inside, K_inverse = reference
    pixels, depth, normal, offsets = patches
    height, width = image.shape
    across = 2 * radius + 1
    template, weight = np.empty(across * across), np.empty(across * across)
    best = np.empty(agreeing)
    rays = np.empty((3, 3))
    for n in range(len(pixels)):
        row, column = pixels[n, 0], pixels[n, 1]
        scores[n, :] = -1.0
        contrast[n] = 0.0
        if not (radius <= row < height - radius and radius <= column < width - radius):
            continue
        cover, variance = _cut_out(image, inside, row, column, radius, template, weight)
        if cover < 0.5 * across * across:
            continue
        contrast[n] = sqrt(variance / cover)
        if contrast[n] < least_contrast:
            continue
        _write_rays(K_inverse, normal[n], row, column, rays)
        _write_scores(
            others, rays, depth[n], offsets, radius, template, weight, cover, variance, best, scores[n]
        )


@_inner
def _cut_out(image, inside, row, column, radius, template, weight):
    """Fill a patch's grey values, their mean 0, and weights; how many pixels count, and the sum of squares."""
    cover, mean, k = 0.0, 0.0, 0
    for i in range(-radius, radius + 1):
        for j in range(-radius, radius + 1):
            w = 1.0 if inside[row + i, column + j] > 0.5 else 0.0
            value = image[row + i, column + j]
            template[k], weight[k] = value, w
            cover += w
            mean += w * value
            k += 1
    mean /= cover
    variance = 0.0
    for k in range(len(template)):
        template[k] = (template[k] - mean) * weight[k]
        variance += template[k] * template[k]
    return cover, variance


@_inner
def _write_rays(K_inverse, normal, row, column, rays):
    """Write the ray of a pixel, and along which the surface is left when the pixel goes one to the right or down: on
    the plane of the normal."""
    ray, right, down = rays[0], rays[1], rays[2]
    for c in range(3):
        ray[c] = K_inverse[c, 0] * column + K_inverse[c, 1] * row + K_inverse[c, 2]
    facing = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    by_x = normal[0] * K_inverse[0, 0]
    by_y = normal[1] * K_inverse[1, 1]
    for c in range(3):
        right[c] = K_inverse[c, 0] - ray[c] * by_x / facing
        down[c] = K_inverse[c, 1] - ray[c] * by_y / facing


@_inner
def _write_scores(others, rays, depth, offsets, radius, template, weight, cover, variance, best, scores):
    """Write a patch's mean correlation with the views that agree best, at each depth."""
    images, P = others
    ray, right, down = rays[0], rays[1], rays[2]
    height, width = images.shape[1:]
    for d in range(len(offsets)):
        z = depth + offsets[d]
        for m in range(len(best)):
            best[m] = -1.0
        for o in range(len(images)):
            w0 = P[o, 2, 3] + z * (P[o, 2, 0] * ray[0] + P[o, 2, 1] * ray[1] + P[o, 2, 2] * ray[2])
            if w0 <= 1e-6:
                continue
            u0 = (P[o, 0, 3] + z * (P[o, 0, 0] * ray[0] + P[o, 0, 1] * ray[1] + P[o, 0, 2] * ray[2])) / w0
            v0 = (P[o, 1, 3] + z * (P[o, 1, 0] * ray[0] + P[o, 1, 1] * ray[1] + P[o, 1, 2] * ray[2])) / w0
            if not (radius < u0 < width - radius - 1 and radius < v0 < height - radius - 1):
                continue
            wx = z * (P[o, 2, 0] * right[0] + P[o, 2, 1] * right[1] + P[o, 2, 2] * right[2])
            wy = z * (P[o, 2, 0] * down[0] + P[o, 2, 1] * down[1] + P[o, 2, 2] * down[2])
            ux = (z * (P[o, 0, 0] * right[0] + P[o, 0, 1] * right[1] + P[o, 0, 2] * right[2]) - u0 * wx) / w0
            uy = (z * (P[o, 0, 0] * down[0] + P[o, 0, 1] * down[1] + P[o, 0, 2] * down[2]) - u0 * wy) / w0
            vx = (z * (P[o, 1, 0] * right[0] + P[o, 1, 1] * right[1] + P[o, 1, 2] * right[2]) - v0 * wx) / w0
            vy = (z * (P[o, 1, 0] * down[0] + P[o, 1, 1] * down[1] + P[o, 1, 2] * down[2]) - v0 * wy) / w0
            if ux * vy - uy * vx <= 0.2:  # seen from behind, or too slanted to be compared
                continue
            total, squares, together, k = 0.0, 0.0, 0.0, 0
            for i in range(-radius, radius + 1):
                for j in range(-radius, radius + 1):
                    if weight[k] > 0:
                        x = min(max(u0 + ux * j + uy * i, 0.0), width - 1.001)
                        y = min(max(v0 + vx * j + vy * i, 0.0), height - 1.001)
                        r, c = int(y), int(x)
                        fy, fx = y - r, x - c
                        upper = images[o, r, c] * (1 - fx) + images[o, r, c + 1] * fx
                        lower = images[o, r + 1, c] * (1 - fx) + images[o, r + 1, c + 1] * fx
                        value = upper * (1 - fy) + lower * fy
                        total += value
                        squares += value * value
                        together += template[k] * value
                    k += 1
            spread = squares - total * total / cover
            _keep_best(best, together / sqrt((variance + 1e-6) * max(spread, cover)))
        mean_score = 0.0
        for m in range(len(best)):
            mean_score += best[m]
        scores[d] = mean_score / len(best)


@numba.njit(inline="always", fastmath=REORDER, **OPTIONS)
def _keep_best(best, score):
    """Put a score among the best ones, which descend."""
    for m in range(len(best)):
        if score > best[m]:
            for q in range(len(best) - 1, m, -1):
                best[q] = best[q - 1]
            best[m] = score
            break
