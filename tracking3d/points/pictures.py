"""Whole frames as points beside the surface are followed in them, and small windows of them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.scene.surface import sample
from tracking3d.scene.view import Array

Grey = NDArray[np.uint8]
Patches = NDArray[np.float32]

RADIUS = 6
"""Pixels on either side of a point that its patch holds."""
_OFFSETS = np.arange(-RADIUS, RADIUS + 1, dtype=np.float32)
_GAP = 4.0  # squared grey values: what keeps the likeness of two plain patches from being that of their noise


@dataclass(frozen=True, eq=False)
class Picture:
    """One frame."""

    grey: Grey  # (H, W)
    # (H, W) float32 pixels to the outline of the object's mask: above 0 on the object, below beside it
    inside: NDArray[np.float32]

    def depth_in_mask(self, xy: Array) -> NDArray[np.float32]:
        """``(N,)`` pixels by which pixels ``(N, 2)`` lie inside the mask; below 0 beside it."""
        return sample(self.inside, xy)

    def holds(self, xy: Array) -> NDArray[np.bool_]:
        """``(N,)`` which pixels ``(N, 2)`` lie in the frame."""
        height, width = self.grey.shape
        with np.errstate(invalid="ignore"):
            return np.asarray(((xy > -0.5) & (xy < (width - 0.5, height - 0.5))).all(1))


def open_picture(image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> Picture:
    """A frame ``(H, W, 3)`` RGB with the mask ``(H, W)`` of the object in it."""
    outside = np.float32(max(mask.shape))
    if mask.all() or not mask.any():
        inside = np.full(mask.shape, outside if mask.any() else -outside, np.float32)
    else:
        within = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
        beyond = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
        # Pixel centres on either side of the outline are half a pixel away from it, not one.
        inside = np.where(mask, within - 0.5, 0.5 - beyond).astype(np.float32)
    return Picture(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), inside)


def patches(grey: Grey, xy: Array) -> Patches:
    """``(N, 13, 13)`` grey values around pixels ``(N, 2)``; beyond the border those at it."""
    at = np.nan_to_num(xy, nan=-1e4).clip(-1e4, 3e4).astype(np.float32)
    side = len(_OFFSETS)
    x = at[:, 0, None, None] + np.broadcast_to(_OFFSETS, (side, side))
    y = at[:, 1, None, None] + np.broadcast_to(_OFFSETS[:, None], (side, side))
    found = np.empty((len(xy), side, side), np.float32)
    most = 2**15 // side - 1  # rows that OpenCV takes at once
    for first in range(0, len(xy), most):
        rows = slice(first, first + most)
        found[rows] = cv2.remap(
            grey,
            x[rows].reshape(-1, side),
            y[rows].reshape(-1, side),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        ).reshape(-1, side, side)
    return found


def likeness(template: Patches, patch: Patches) -> Array:
    """``(N,)`` correlations of patches ``(N, S, S)``; that of plain ones is near 0."""
    a, b = (one - one.mean((1, 2), keepdims=True) for one in (template, patch))
    together = (a * b).mean((1, 2))
    correlation: Array = together / np.sqrt(((a * a).mean((1, 2)) + _GAP) * ((b * b).mean((1, 2)) + _GAP))
    return correlation


def contrast(patch: Patches) -> Array:
    """``(N,)`` deviations of the grey values of patches ``(N, S, S)``."""
    deviation: Array = patch.std((1, 2)).astype(np.float64)
    return deviation


def placement_variance(template: Patches, patch: Patches, least_noise: float) -> Array:
    """How well a patch can be placed on a template: along an edge, or where both are plain, hardly.

    Args:
        template: ``(N, S, S)``.
        patch: ``(N, S, S)``.
        least_noise: Deviation of grey values that say the same.

    Returns:
        ``(N,)`` squared pixels, mean of x and y.
    """
    down, right = np.gradient(template.astype(np.float64), axis=(1, 2))
    xx, xy, yy = (right * right).sum((1, 2)), (right * down).sum((1, 2)), (down * down).sum((1, 2))
    left = (template - template.mean((1, 2), keepdims=True)) - (patch - patch.mean((1, 2), keepdims=True))
    noise = np.maximum((left.astype(np.float64) ** 2).mean((1, 2)), least_noise**2)
    hold = noise / template[0].size if len(template) else noise  # a shift of several pixels is no surprise
    det = (xx + hold) * (yy + hold) - xy * xy
    variance: Array = noise * (xx + yy + 2 * hold) / det / 2
    return variance
