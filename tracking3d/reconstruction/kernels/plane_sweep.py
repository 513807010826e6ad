"""Depth from patches along the known motion; `tracking3d.reconstruction.plane_sweep` says what is computed."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import REORDER, kernel


@kernel(
    "void(float32[:,::1], float32[:,::1], float64[:,::1], float32[:,:,::1], float64[:,:,::1], int64[:,::1],"
    " float64[::1], float64[:,::1], float64[::1], int64, float64, int64, float32[:,::1], float32[::1])",
    fastmath=REORDER,
)
def sweep(
    image: NDArray[Any],
    inside: NDArray[Any],
    K_inverse: NDArray[Any],
    others: NDArray[Any],
    P: NDArray[Any],
    pixels: NDArray[Any],
    depth: NDArray[Any],
    normal: NDArray[Any],
    offsets: NDArray[Any],
    radius: int,
    least_contrast: float,
    agreeing: int,
    scores: NDArray[Any],
    contrast: NDArray[Any],
) -> None:
    """Fill ``scores`` (N, D): agreement of each pixel's patch with the other views at each depth; -1 where unknown."""
    height, width = image.shape
    across = 2 * radius + 1
    template, weight = np.empty(across * across), np.empty(across * across)
    best = np.empty(agreeing)
    ray, right, down = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(pixels)):
        row, column = pixels[n, 0], pixels[n, 1]
        scores[n, :] = -1.0
        contrast[n] = 0.0
        if not (radius <= row < height - radius and radius <= column < width - radius):
            continue
        cover, mean, k = 0.0, 0.0, 0
        for i in range(-radius, radius + 1):
            for j in range(-radius, radius + 1):
                w = 1.0 if inside[row + i, column + j] > 0.5 else 0.0
                value = image[row + i, column + j]
                template[k], weight[k] = value, w
                cover += w
                mean += w * value
                k += 1
        if cover < 0.5 * across * across:
            continue
        mean /= cover
        variance = 0.0
        for k in range(across * across):
            template[k] = (template[k] - mean) * weight[k]
            variance += template[k] * template[k]
        contrast[n] = sqrt(variance / cover)
        if contrast[n] < least_contrast:
            continue
        # Along which the surface is left when the pixel goes one to the right or down: on the plane of the normal.
        for c in range(3):
            ray[c] = K_inverse[c, 0] * column + K_inverse[c, 1] * row + K_inverse[c, 2]
        facing = normal[n, 0] * ray[0] + normal[n, 1] * ray[1] + normal[n, 2] * ray[2]
        by_x = normal[n, 0] * K_inverse[0, 0]
        by_y = normal[n, 1] * K_inverse[1, 1]
        for c in range(3):
            right[c] = K_inverse[c, 0] - ray[c] * by_x / facing
            down[c] = K_inverse[c, 1] - ray[c] * by_y / facing
        for d in range(len(offsets)):
            z = depth[n] + offsets[d]
            for m in range(agreeing):
                best[m] = -1.0
            for o in range(len(others)):
                w0 = P[o, 2, 3] + z * (P[o, 2, 0] * ray[0] + P[o, 2, 1] * ray[1] + P[o, 2, 2] * ray[2])
                if w0 <= 1e-6:
                    continue
                u0 = (P[o, 0, 3] + z * (P[o, 0, 0] * ray[0] + P[o, 0, 1] * ray[1] + P[o, 0, 2] * ray[2])) / w0
                v0 = (P[o, 1, 3] + z * (P[o, 1, 0] * ray[0] + P[o, 1, 1] * ray[1] + P[o, 1, 2] * ray[2])) / w0
                if not (radius < u0 < width - radius - 1 and radius < v0 < height - radius - 1):
                    continue
                wx = z * (P[o, 2, 0] * right[0] + P[o, 2, 1] * right[1] + P[o, 2, 2] * right[2])
                wy = z * (P[o, 2, 0] * down[0] + P[o, 2, 1] * down[1] + P[o, 2, 2] * down[2])
                ux = (
                    z * (P[o, 0, 0] * right[0] + P[o, 0, 1] * right[1] + P[o, 0, 2] * right[2]) - u0 * wx
                ) / w0
                uy = (z * (P[o, 0, 0] * down[0] + P[o, 0, 1] * down[1] + P[o, 0, 2] * down[2]) - u0 * wy) / w0
                vx = (
                    z * (P[o, 1, 0] * right[0] + P[o, 1, 1] * right[1] + P[o, 1, 2] * right[2]) - v0 * wx
                ) / w0
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
                            upper = others[o, r, c] * (1 - fx) + others[o, r, c + 1] * fx
                            lower = others[o, r + 1, c] * (1 - fx) + others[o, r + 1, c + 1] * fx
                            value = upper * (1 - fy) + lower * fy
                            total += value
                            squares += value * value
                            together += template[k] * value
                        k += 1
                spread = squares - total * total / cover
                score = together / sqrt((variance + 1e-6) * max(spread, cover))
                for m in range(agreeing):
                    if score > best[m]:
                        for q in range(agreeing - 1, m, -1):
                            best[q] = best[q - 1]
                        best[m] = score
                        break
            mean_score = 0.0
            for m in range(agreeing):
                mean_score += best[m]
            scores[n, d] = mean_score / agreeing
