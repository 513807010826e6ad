"""Patches aligned one after the other; `tracking3d.points.alignment` says what is computed."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, REORDER, kernel


@numba.njit(inline="always", fastmath=REORDER, **OPTIONS)
def _between(plane: NDArray[Any], x: float, y: float) -> Any:
    height, width = plane.shape
    x = min(max(x, 0.0), width - 1.001)
    y = min(max(y, 0.0), height - 1.001)
    row, column = int(y), int(x)
    right, down = x - column, y - row
    upper = plane[row, column] * (1 - right) + plane[row, column + 1] * right
    lower = plane[row + 1, column] * (1 - right) + plane[row + 1, column + 1] * right
    return upper * (1 - down) + lower * down


@numba.njit(inline="always", fastmath=REORDER, **OPTIONS)
def _patch(plane: NDArray[Any], x: float, y: float, half: int, values: NDArray[Any]) -> bool:
    """Fill ``values`` ((2 half + 1)^2) around ``x, y``, where all of it lies within the plane; all pixels lie alike
    between those of the plane."""
    height, width = plane.shape
    if not (x >= half and y >= half and x + half <= width - 1.001 and y + half <= height - 1.001):
        return False
    row, column = int(y), int(x)
    right, down = x - column, y - row
    left_up, right_up = (1 - right) * (1 - down), right * (1 - down)
    left_down, right_down = (1 - right) * down, right * down
    side = 2 * half + 1
    for i in range(side):
        upper, lower = plane[row - half + i], plane[row - half + i + 1]
        for j in range(side):
            at = column - half + j
            values[i * side + j] = (
                left_up * upper[at]
                + right_up * upper[at + 1]
                + left_down * lower[at]
                + right_down * lower[at + 1]
            )
    return True


@kernel(
    "void(float32[:,::1], float32[:,::1], float32[:,::1], float64[:,::1], float64[:,::1], float64, float64, float64,"
    " int64, float64[:,::1], float64[:,::1], float64[:,::1], int64, int64)",
    fastmath=REORDER,
)
def align(
    template: NDArray[Any],
    weight: NDArray[Any],
    image: NDArray[Any],
    xy: NDArray[Any],
    window: NDArray[Any],
    prior: float,
    noise: float,
    least_cover: float,
    steps: int,
    shift: NDArray[Any],
    covariance: NDArray[Any],
    agreement: NDArray[Any],
    first: int,
    last: int,
) -> None:
    """Fill ``shift`` (N, 2), ``covariance`` (N, 3) as xx, xy, yy, and ``agreement`` (N, 2): correlation, and
    contrast of the template; of the points from ``first`` to before ``last``."""
    side = window.shape[0]
    radius, count = side // 2, side * side
    T, w = np.empty(count), np.empty(count)
    gx, gy = np.empty(count), np.empty(count)
    here, known, wider = np.empty(count), np.empty(count), np.empty((side + 2) ** 2)
    total = window.sum()
    height, width = template.shape
    for p in range(first, last):
        px, py = xy[p, 0], xy[p, 1]
        shift[p] = 0.0
        covariance[p] = np.inf
        agreement[p, 0], agreement[p, 1] = -1.0, 0.0
        if not (-radius < px < width + radius and -radius < py < height + radius):
            continue
        cover, mean = 0.0, 0.0
        if _patch(template, px, py, radius + 1, wider) and _patch(weight, px, py, radius, known):
            for i in range(side):
                for j in range(side):
                    k, at = i * side + j, (i + 1) * (side + 2) + j + 1
                    w[k] = window[i, j] * known[k]
                    T[k] = wider[at]
                    gx[k] = 0.5 * (wider[at + 1] - wider[at - 1])
                    gy[k] = 0.5 * (wider[at + side + 2] - wider[at - side - 2])
        else:
            for i in range(side):
                for j in range(side):
                    k = i * side + j
                    x, y = px + j - radius, py + i - radius
                    within = 1.0 <= x <= width - 2.0 and 1.0 <= y <= height - 2.0
                    w[k] = window[i, j] * _between(weight, x, y) if within else 0.0
                    T[k] = _between(template, x, y)
                    gx[k] = 0.5 * (_between(template, x + 1, y) - _between(template, x - 1, y))
                    gy[k] = 0.5 * (_between(template, x, y + 1) - _between(template, x, y - 1))
        for k in range(count):
            cover += w[k]
            mean += w[k] * T[k]
        if cover < least_cover * total:
            continue
        mean /= cover
        variance, mean_x, mean_y = 0.0, 0.0, 0.0
        for k in range(count):
            w[k] /= cover
            T[k] -= mean
            variance += w[k] * T[k] * T[k]
            mean_x += w[k] * gx[k]
            mean_y += w[k] * gy[k]
        agreement[p, 1] = sqrt(variance)
        for k in range(count):
            gx[k] -= mean_x
            gy[k] -= mean_y
        dx, dy = 0.0, 0.0
        step = 0
        while True:
            if not _patch(image, px + dx, py + dy, radius, here):
                for i in range(side):
                    for j in range(side):
                        here[i * side + j] = _between(image, px + j - radius + dx, py + i - radius + dy)
            mean_here = 0.0
            for k in range(count):
                mean_here += w[k] * here[k]
            variance_here, together = 0.0, 0.0
            for k in range(count):
                here[k] -= mean_here
                variance_here += w[k] * here[k] * here[k]
                together += w[k] * here[k] * T[k]
            gain = min(max(together / (variance + 1e-6), 0.4), 2.5)
            hxx, hxy, hyy, bx, by, residual = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                r = here[k] - gain * T[k]
                ax, ay = gain * gx[k], gain * gy[k]
                robust = 9 * noise * noise / (9 * noise * noise + r * r)
                u = w[k] * robust * robust
                hxx += u * ax * ax
                hxy += u * ax * ay
                hyy += u * ay * ay
                bx -= u * ax * r
                by -= u * ay * r
                residual += w[k] * r * r
            if step < 0:
                break
            hold = noise * noise / (cover * prior * prior) * 6
            bx -= hold * dx
            by -= hold * dy
            det = (hxx + hold) * (hyy + hold) - hxy * hxy
            sx = ((hyy + hold) * bx - hxy * by) / det
            sy = ((hxx + hold) * by - hxy * bx) / det
            length = sqrt(sx * sx + sy * sy)
            if length > 1:
                sx, sy = sx / length, sy / length
            dx += sx
            dy += sy
            step += 1
            if length < 0.02 or step >= steps:
                step = -1  # once more, for what is told of the end
        shift[p, 0], shift[p, 1] = dx, dy
        agreement[p, 0] = together / sqrt((variance + 4) * (variance_here + 4))
        error = max(noise * noise, residual) / cover * 6
        hold = error / (prior * prior)
        det = (hxx + hold) * (hyy + hold) - hxy * hxy
        covariance[p, 0] = error * (hyy + hold) / det
        covariance[p, 1] = -error * hxy / det
        covariance[p, 2] = error * (hxx + hold) / det
