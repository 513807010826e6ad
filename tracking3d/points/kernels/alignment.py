"""Patches aligned one after the other; `tracking3d.points.warping` says what is computed."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from math import sqrt
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import float32, float64, int64, void
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, REORDER, kernel, record

_STRIDE = 16
"""Pixels from one row of a patch to the next: whole vectors. It holds a window and a pixel on either side of it, so
that a window has up to 14 pixels; what is beyond the window has no weight."""
_NONE: Any = np.float32(0)
_HALF, _ONE = np.float32(0.5), np.float32(1)


class AlignedPlanes(NamedTuple):
    """Template, how much of it is known, and the image that it is aligned with, all ``(h, w)``."""

    template: NDArray[np.float32]
    weight: NDArray[np.float32]
    image: NDArray[np.float32]


class AlignmentSettings(NamedTuple):
    """How patches are aligned."""

    window: NDArray[np.float64]  # (S, S) weights of a patch's pixels
    prior: float  # deviation in pixels of the shifts that are expected
    noise: float  # deviation of grey values that say the same
    least_cover: float  # share of the window in which the template has to be known
    steps: int  # the most that are taken


class AlignmentArrays(NamedTuple):
    """What is found out of N points, written to."""

    shift: NDArray[np.float64]  # (N, 2)
    covariance: NDArray[np.float64]  # (N, 3) as xx, xy, yy
    agreement: NDArray[np.float64]  # (N, 2): correlation, and contrast of the template


_PLANES = record(AlignedPlanes, float32[:, ::1], float32[:, ::1], float32[:, ::1])
_SETTINGS = record(AlignmentSettings, float64[:, ::1], float64, float64, float64, int64)
_FOUND = record(AlignmentArrays, float64[:, ::1], float64[:, ::1], float64[:, ::1])

_inner = numba.njit(inline="always", fastmath=REORDER, **OPTIONS)


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
    """Fill ``values``, rows of `_STRIDE`, around ``x, y``, where all of it lies within the plane; all pixels lie alike
    between those of the plane."""
    height, width = plane.shape
    if not (x >= half and y >= half and x - half + _STRIDE <= width - 1.001 and y + half <= height - 1.001):
        return False
    row, column = int(y), int(x)
    right, down = np.float32(x - column), np.float32(y - row)
    left, up = _ONE - right, _ONE - down
    left_up, right_up = left * up, right * up
    left_down, right_down = left * down, right * down
    for i in range(2 * half + 1):
        # Counted from the patch's own edge, no index can be negative, which the compiler would have to look for.
        upper = plane[row - half + i, column - half : column - half + _STRIDE + 1]
        lower = plane[row - half + i + 1, column - half : column - half + _STRIDE + 1]
        into = values[i * _STRIDE : (i + 1) * _STRIDE]
        for j in range(_STRIDE):
            into[j] = (
                left_up * upper[j]
                + right_up * upper[j + 1]
                + left_down * lower[j]
                + right_down * lower[j + 1]
            )
    return True


@kernel(void(_PLANES, float64[:, ::1], _SETTINGS, _FOUND, int64, int64), fastmath=REORDER)
def align(
    planes: AlignedPlanes,
    xy: NDArray[Any],
    settings: AlignmentSettings,
    found: AlignmentArrays,
    first: int,
    last: int,
) -> None:
    """Fill what is found out of the points ``xy`` ``(N, 2)`` from ``first`` to before ``last``."""
    template, weight, image = planes
    window, prior, noise, least_cover, steps = settings
    shift, covariance, agreement = found
    side = window.shape[0]
    radius, count = side // 2, side * _STRIDE
    # Single precision: twice as many pixels fit into a vector, and grey values have eight bits.
    T, w, share = np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    gx, gy = np.zeros(count, np.float32), np.zeros(count, np.float32)
    here, known = np.zeros(count, np.float32), np.zeros(count, np.float32)
    wider = np.zeros((side + 3) * _STRIDE, np.float32)
    for i in range(side):
        for j in range(side):
            share[i * _STRIDE + j] = window[i, j]
    total = window.sum()
    spread = np.float32(9 * noise * noise)
    height, width = template.shape
    for p in range(first, last):
        px, py = xy[p, 0], xy[p, 1]
        shift[p] = 0.0
        covariance[p] = np.inf
        agreement[p, 0], agreement[p, 1] = -1.0, 0.0
        if not (-radius < px < width + radius and -radius < py < height + radius):
            continue
        if _patch(template, px, py, radius + 1, wider) and _patch(weight, px, py, radius, known):
            _cut_out(share, known, wider, w, T, gx, gy)
        else:
            _cut_out_at_border(template, weight, window, px, py, w, T, gx, gy)
        cover, variance = _levelled(w, T, gx, gy, least_cover * total)
        if cover == 0:
            continue
        agreement[p, 1] = sqrt(variance)
        hold = noise * noise / (cover * prior * prior) * 6
        dx, dy, together, hxx, hxy, hyy, residual, variance_here = _stepped(
            image, px, py, steps, hold, spread, w, T, gx, gy, here, variance
        )
        shift[p, 0], shift[p, 1] = dx, dy
        agreement[p, 0] = together / sqrt((variance + 4) * (variance_here + 4))
        error = max(noise * noise, residual) / cover * 6
        hold = error / (prior * prior)
        det = (hxx + hold) * (hyy + hold) - hxy * hxy
        covariance[p, 0] = error * (hyy + hold) / det
        covariance[p, 1] = -error * hxy / det
        covariance[p, 2] = error * (hxx + hold) / det


@_inner
def _cut_out(share, known, wider, w, T, gx, gy):
    """Fill weights ``w``, template ``T`` and its slopes from a patch that has a pixel more on every side."""
    count = len(w) // _STRIDE * _STRIDE
    # One array a loop: of more the compiler does not find out that they lie apart.
    for k in range(count):
        w[k] = share[k] * known[k]
    for k in range(count):
        T[k] = wider[k + _STRIDE + 1]
    for k in range(count):
        gx[k] = _HALF * (wider[k + _STRIDE + 2] - wider[k + _STRIDE])
    for k in range(count):
        gy[k] = _HALF * (wider[k + 2 * _STRIDE + 1] - wider[k + 1])


@_inner
def _cut_out_at_border(template, weight, window, px, py, w, T, gx, gy):
    """The same pixel by pixel, around a place that is near the border of the planes."""
    height, width = template.shape
    side = window.shape[0]
    radius = side // 2
    for i in range(side):
        for j in range(side):
            k = i * _STRIDE + j
            x, y = px + j - radius, py + i - radius
            within = 1.0 <= x <= width - 2.0 and 1.0 <= y <= height - 2.0
            w[k] = window[i, j] * _between(weight, x, y) if within else 0.0
            T[k] = _between(template, x, y)
            gx[k] = 0.5 * (_between(template, x + 1, y) - _between(template, x - 1, y))
            gy[k] = 0.5 * (_between(template, x, y + 1) - _between(template, x, y - 1))


@_inner
def _levelled(w, T, gx, gy, least):
    """Make the sum of the weights 1 and the means 0; what the sum was, and the template's variance.

    Both are 0 if the sum was less than ``least``.
    """
    count = len(w) // _STRIDE * _STRIDE
    cover, mean = _NONE, _NONE
    for k in range(count):
        cover += w[k]
        mean += w[k] * T[k]
    variance, mean_x, mean_y = _NONE, _NONE, _NONE
    if cover < least:
        return _NONE, variance
    mean = mean / cover
    part = _ONE / cover
    for k in range(count):
        w[k] *= part
    for k in range(count):
        T[k] -= mean
    for k in range(count):
        variance += w[k] * T[k] * T[k]
        mean_x += w[k] * gx[k]
        mean_y += w[k] * gy[k]
    for k in range(count):
        gx[k] -= mean_x
    for k in range(count):
        gy[k] -= mean_y
    return cover, variance


@_inner
def _stepped(image, px, py, steps, hold, spread, w, T, gx, gy, here, variance):
    """Step to where the patch lies in the image.

    Returns:
        The shift by x and y; at the last step the covariance of both patches, xx, xy and yy of the matrix and the
        mean square that was left; and the variance of the image's patch.
    """
    side = len(w) // _STRIDE
    radius, count = side // 2, side * _STRIDE
    dx, dy = 0.0, 0.0
    for _ in range(steps):
        if not _patch(image, px + dx, py + dy, radius, here):
            for i in range(side):
                for j in range(side):
                    here[i * _STRIDE + j] = _between(image, px + j - radius + dx, py + i - radius + dy)
        mean_here, together = _NONE, _NONE
        for k in range(count):
            mean_here += w[k] * here[k]
            together += w[k] * here[k] * T[k]  # whatever the mean: that of T is 0
        gain = np.float32(min(max(together / (variance + 1e-6), 0.4), 2.5))
        sxx, sxy, syy, gradient_x, gradient_y, residual = _NONE, _NONE, _NONE, _NONE, _NONE, _NONE
        for k in range(count):
            r = here[k] - mean_here - gain * T[k]
            robust = spread / (spread + r * r)
            u = w[k] * robust * robust
            ux, uy = u * gx[k], u * gy[k]
            sxx += ux * gx[k]
            sxy += ux * gy[k]
            syy += uy * gy[k]
            gradient_x += ux * r
            gradient_y += uy * r
            residual += w[k] * r * r
        hxx, hxy, hyy = (
            gain * gain * np.float64(sxx),
            gain * gain * np.float64(sxy),
            gain * gain * np.float64(syy),
        )
        bx, by = -gain * np.float64(gradient_x), -gain * np.float64(gradient_y)
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
        if length < 0.02:
            break  # what was found out so near to the end is told of it
    variance_here = _NONE
    for k in range(count):
        variance_here += w[k] * (here[k] - mean_here) * (here[k] - mean_here)
    return dx, dy, together, hxx, hxy, hyy, residual, variance_here
