"""Rough masks with one known fault: a boundary that is a given number of pixels off, or a hand that is taken for the
object.

Where `tracking3d_bench.synthesis.mask_degradation` mixes all faults until a mean IoU is met, these tell apart noise
with the mean zero, which a good fit averages out, and a bias, which it cannot.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

Masks = NDArray[np.bool_]
"""``(N, H, W)``."""

HAND_ON, HAND_OFF = 12, 6
"""Frames for which the hand is part of the mask, and those until the next time."""

_CORRELATION = (
    2.0  # length along the boundary over which its shift changes, in standard deviations of the shift
)
_PALM, _ARM = (
    0.26,
    0.15,
)  # radius of the palm and half the arm's width, relative to the root of the object's area


def noisy_boundaries(masks: Masks, pixels: float, seed: int) -> Masks:
    """Masks whose boundary is shifted in and out by noise of mean zero, new in every frame but the first.

    Args:
        masks: ``(N, H, W)`` true masks.
        pixels: Standard deviation of the shift.
        seed: Seed of the noise.

    Raises:
        ValueError: If ``pixels`` is not positive.
    """
    if not 0 < pixels < math.inf:
        raise ValueError(f"pixels needs to be positive, got {pixels}")
    rng = np.random.default_rng(seed)
    noisy = masks.copy()
    for n in range(1, len(masks)):
        shift = gaussian_filter(rng.standard_normal(masks.shape[1:]), _CORRELATION * pixels, mode="wrap")
        noisy[n] = boundary_distance(masks[n]) > pixels * shift / shift.std() if masks[n].any() else False
    return noisy


def with_hand(masks: Masks, seed: int) -> Masks:
    """Masks that a hand and its arm belong to for 12 frames, not for 6, and so on; never to the first.

    The hand holds the object from one side: it goes where the object goes, and does not turn with it. Every time it
    comes from another side.

    Args:
        masks: ``(N, H, W)`` true masks.
        seed: Seed of the sides.
    """
    rng = np.random.default_rng(seed)
    biased = masks.copy()
    turn = rng.uniform(0, 2 * math.pi)
    for start in range(HAND_OFF // 2, len(masks), HAND_ON + HAND_OFF):
        turn += rng.uniform(0.4, 0.9) * math.pi
        for n in range(start, min(start + HAND_ON, len(masks))):
            if masks[n].any():
                biased[n] |= _hand(masks[n], turn + 0.02 * (n - start))
    return biased


def boundary_distance(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Distance ``(H, W)`` in pixels of every pixel's centre to the boundary of a mask ``(H, W)``, positive inside."""
    inside, outside = (cv2.distanceTransform(part.astype(np.uint8), cv2.DIST_L2, 5) for part in (mask, ~mask))
    # Pixel centres next to the boundary are half a pixel away from it, not one.
    return np.where(mask, inside - 0.5, 0.5 - outside).astype(np.float64)


def _hand(mask: NDArray[np.bool_], angle: float) -> NDArray[np.bool_]:
    """A palm ``(H, W)`` at the outline of a mask in the direction ``angle``, and an arm from there to the border."""
    rows, columns = np.nonzero(mask)
    size = math.sqrt(len(rows))
    along = np.array([math.cos(angle), math.sin(angle)])
    centre = np.array([columns.mean(), rows.mean()])
    reach = ((np.stack([columns, rows], 1) - centre) @ along).max()
    palm = centre + (reach + 0.5 * _PALM * size) * along
    end = palm + sum(mask.shape) * along
    canvas = np.zeros(mask.shape, np.uint8)
    start, stop = (tuple(int(value) for value in point.round()) for point in (palm, end))
    cv2.circle(canvas, start, max(1, round(_PALM * size)), 1, -1)
    cv2.line(canvas, start, stop, 1, max(1, round(2 * _ARM * size)))
    return canvas.astype(bool)
