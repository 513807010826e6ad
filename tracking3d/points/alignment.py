"""How far the image lies from what was expected of it, around many points at once.

The expected image is already warped into the view, so what is left is a shift. Forwards additive alignment
with the gradients of the template (Hager and Belhumeur, "Efficient region tracking with parametric models of
geometry and illumination", 1998): gain and offset of the brightness are free, pixels weigh by a Gaussian window, by
how much of the template is known there, and by a robust function of what is left. A prior holds the shift at zero,
so that it goes only where the image says so: along an edge, or where there is no texture, the prediction stands, and
the covariance says it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.points.view import Array, Plane
from tracking3d.rendering.backend import use_numba

RADIUS, DEVIATION = 6, 3.0
"""Of the window, in pixels: half its side, and the deviation of its Gaussian."""
NOISE = 4.0
"""Deviation of grey values that say the same."""
LEAST_COVER = 0.2
"""Share of the window in which the template has to be known."""
STEPS = 8
_LEAST_SHARED = 64  # points for which another thread pays


@dataclass(frozen=True, eq=False)
class Alignment:
    """What N patches say.

    Attributes:
        shift: ``(N, 2)`` pixels by which the image lies beside the template; 0 where there was nothing to align.
        covariance: ``(N, 3)`` of it, xx, xy and yy in squared pixels; infinite there.
        agreement: ``(N,)`` correlation of the two patches at the end, -1 there.
        contrast: ``(N,)`` deviation of the template's grey values, 0 there.
    """

    shift: Array
    covariance: Array
    agreement: Array
    contrast: Array

    @property
    def variance(self) -> Array:
        """``(N,)`` mean variance of x and y."""
        mean: Array = (self.covariance[:, 0] + self.covariance[:, 2]) / 2
        return mean


def align(
    template: Plane, weight: Plane, image: Plane, xy: Array, prior: float = 1.0, backend: str = "auto"
) -> Alignment:
    """Find what of ``template`` around each point lies where in ``image``.

    Args:
        template: ``(h, w)`` the expected image.
        weight: ``(h, w)`` in [0, 1]: how much of it is known.
        image: ``(h, w)`` the image.
        xy: ``(N, 2)`` pixels of the template; a point that is not finite is not aligned.
        prior: Deviation in pixels of the shifts that are expected.
        backend: ``numba``, ``torch`` for NumPy, or ``auto``; see `tracking3d.rendering.backend`.
    """
    planes = [np.ascontiguousarray(plane, dtype=np.float32) for plane in (template, weight, image)]
    points = np.ascontiguousarray(xy, dtype=np.float64)
    window = _window()
    if not use_numba(backend, torch.empty(0, dtype=torch.float32)):
        return _align_together(planes[0], planes[1], planes[2], points, window, prior)
    from tracking3d.points.kernels.alignment import align as compiled
    from tracking3d.rendering.kernels.threads import share

    count = len(points)
    shift, covariance, agreement = np.empty((count, 2)), np.empty((count, 3)), np.empty((count, 2))
    out = shift, covariance, agreement
    share(compiled, count, _LEAST_SHARED, *planes, points, window, prior, NOISE, LEAST_COVER, STEPS, *out)
    return Alignment(shift, covariance, agreement[:, 0], agreement[:, 1])


def _window() -> Array:
    offset = np.arange(-RADIUS, RADIUS + 1.0)
    return np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * DEVIATION**2))


def _align_together(
    template: Plane, weight: Plane, image: Plane, xy: Array, window: Array, prior: float
) -> Alignment:
    """The same as the kernel in NumPy, all points at once."""
    height, width = template.shape
    count = len(xy)
    shift, covariance = np.zeros((count, 2)), np.full((count, 3), np.inf)
    agreement, contrast = np.full(count, -1.0), np.zeros(count)
    with np.errstate(invalid="ignore"):
        near = ((xy > -RADIUS) & (xy < np.array([width, height]) + RADIUS)).all(1)
    y, x = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1]
    offsets = np.stack([x.ravel(), y.ravel()], 1).astype(np.float64)
    at = xy[near, None] + offsets  # (n, S, 2)
    inside = ((at >= 1) & (at <= np.array([width, height]) - 2.0)).all(2)
    w = window.ravel() * np.where(inside, _between(weight, at), 0)
    cover = w.sum(1)
    enough = cover >= LEAST_COVER * window.sum()
    chosen = np.flatnonzero(near)[enough]
    if not len(chosen):
        return Alignment(shift, covariance, agreement, contrast)
    at, w, cover = at[enough], w[enough] / cover[enough, None], cover[enough, None]
    T = _between(template, at)
    T = T - (w * T).sum(1, keepdims=True)
    variance = (w * T * T).sum(1, keepdims=True)
    right, down = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    slope = np.stack(
        [0.5 * (_between(template, at + d) - _between(template, at - d)) for d in (right, down)], 2
    )
    slope = slope - (w[..., None] * slope).sum(1, keepdims=True)
    moved, going = np.zeros((len(at), 2)), np.ones(len(at), bool)
    H, left = np.zeros((len(at), 2, 2)), np.zeros(w.shape)
    together, variance_here = np.zeros((len(at), 1)), np.zeros(len(at))
    for _ in range(STEPS):
        here = _between(image, at[going] + moved[going, None])
        share = w[going]
        here = here - (share * here).sum(1, keepdims=True)
        variance_here[going] = (share * here * here).sum(1)
        together[going] = (share * here * T[going]).sum(1, keepdims=True)
        gain = np.clip(together[going] / (variance[going] + 1e-6), 0.4, 2.5)
        left[going] = here - gain * T[going]
        u = share * (9 * NOISE**2 / (9 * NOISE**2 + left[going] ** 2)) ** 2
        a = gain[..., None] * slope[going]
        H[going] = np.einsum("ns,nsi,nsj->nij", u, a, a)
        hold = NOISE**2 / (cover[going] * prior**2) * 6
        b = -np.einsum("ns,nsi,ns->ni", u, a, left[going]) - hold * moved[going]
        move = np.linalg.solve(H[going] + hold[..., None] * np.eye(2), b[..., None])[..., 0]
        length = np.linalg.norm(move, axis=1)
        moved[going] += (1 / np.maximum(length, 1))[:, None] * move
        going[going] = length >= 0.02
        if not going.any():
            break
    error = np.maximum(NOISE**2, (w * left**2).sum(1, keepdims=True)) / cover * 6
    spread = error[..., None] * np.linalg.inv(H + (error / prior**2)[..., None] * np.eye(2))
    shift[chosen] = moved
    covariance[chosen] = np.stack([spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]], 1)
    contrast[chosen] = np.sqrt(variance[:, 0])
    agreement[chosen] = together[:, 0] / np.sqrt((variance[:, 0] + 4) * (variance_here + 4))
    return Alignment(shift, covariance, agreement, contrast)


def _between(plane: Plane, at: Array) -> NDArray[np.float64]:
    """``(n, S)`` values of ``plane`` at ``(n, S, 2)`` pixels."""
    height, width = plane.shape
    x, y = np.clip(at[..., 0], 0, width - 1.001), np.clip(at[..., 1], 0, height - 1.001)
    column, row = x.astype(int), y.astype(int)
    x, y = x - column, y - row
    upper = plane[row, column] * (1 - x) + plane[row, column + 1] * x
    lower = plane[row + 1, column] * (1 - x) + plane[row + 1, column + 1] * x
    values: Array = upper * (1 - y) + lower * y
    return values
