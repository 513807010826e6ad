"""Patches aligned in NumPy, all points at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.points.warping import LEAST_COVER, NOISE, RADIUS, STEPS, Alignment, _window
from tracking3d.scene.view import Array, Plane


def align(template: Plane, weight: Plane, image: Plane, xy: Array, prior: float = 1.0) -> Alignment:
    """See `tracking3d.points.warping.align`."""
    window = _window()
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
