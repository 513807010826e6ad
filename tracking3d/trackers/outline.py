"""What an outline says: a prior from where it may have moved to, its two sides, and a tidy mask.

All masks are those of one square crop, ``(S, S)``, and lengths are in its pixels.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

_REACH = 12  # pixels the outline is shifted at most to fit the evidence
_SHIFT_COST = 0.001  # of the mean support, for every second pixel: without evidence the outline stays
_BACKGROUND_MOTION = -0.4  # pixels: a separate part that moves so much more like the background is none


def inside_distance(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """``(S, S)`` pixels to the outline: positive inside, negative outside."""
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3)
    return inside - cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)


def prior(moved: list[tuple[float, NDArray[np.float32]]], area: int) -> NDArray[np.float32]:
    """``(S, S)`` in [-4, 4]: distance to the outline, averaged over several opinions of where it is.

    Args:
        moved: Weights, and masks ``(S, S)`` in [0, 1].
        area: The object's area; distances are relative to its square root.
    """
    weights, masks = zip(*moved, strict=True)
    distance = np.average([inside_distance(mask > 0.5) for mask in masks], axis=0, weights=weights)
    return np.clip(distance / (0.12 * math.sqrt(area)), -4.0, 4.0).astype(np.float32)


def shifted_to(mask: NDArray[np.float32], evidence: NDArray[np.float32]) -> NDArray[np.float32]:
    """``mask``, shifted without a turn to where ``evidence`` ``(S, S)`` supports it most.

    A side that turns away takes its texture along, and flow with it, while the outline stays where it is.
    """
    half, field = (
        cv2.resize(one, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for one in (mask, evidence)
    )
    reach = _REACH // 2
    padded = cv2.copyMakeBorder(field, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    support = cv2.matchTemplate(padded, half, cv2.TM_CCORR) / max(float(half.sum()), 1.0)
    down, right = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    support -= _SHIFT_COST * np.hypot(down, right)
    row, column = np.unravel_index(int(np.argmax(support)), support.shape)
    shift = np.array([[1, 0, 2 * (column - reach)], [0, 1, 2 * (row - reach)]], np.float32)
    return cv2.warpAffine(mask, shift, mask.shape[::-1])


def both_sides(mask: NDArray) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The object's pixels, and those surely beyond its outline."""
    inside = mask > 0.5
    grown = cv2.dilate(inside.astype(np.uint8), _disc(0.05 * math.sqrt(np.count_nonzero(inside))))
    return inside, grown == 0


def touches_border(mask: NDArray[np.bool_], in_frame: NDArray[np.bool_]) -> bool:
    """Whether ``mask`` reaches the border of the frame, where the crop ``in_frame`` shows it."""
    within = cv2.erode(in_frame.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return bool((mask & in_frame & ~within).any())


def remove_specks(
    mask: NDArray[np.bool_], moved: NDArray[np.bool_], motion: NDArray[np.float32] | None = None
) -> NDArray[np.bool_]:
    """Drop specks, parts that are not the object's, and pinholes.

    Args:
        mask: What the evidence says.
        moved: The last mask moved along; a part of which it covers less than 30 % is dropped.
        motion: The cue of `tracking3d.trackers.mask_motion`; where there are several parts, one that moves like the
            background is dropped.
    """
    area = int(np.count_nonzero(moved))
    disc = _disc(0.02 * math.sqrt(area))
    smooth = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, disc)
    smooth = cv2.morphologyEx(smooth, cv2.MORPH_CLOSE, disc)
    count, labels = cv2.connectedComponents(smooth)
    sizes = np.maximum(np.bincount(labels.ravel(), minlength=count), 1)
    supported = np.bincount(labels[moved], minlength=count) > 0.3 * sizes
    supported[0] = False
    if motion is not None:
        mean_motion = np.bincount(labels.ravel(), motion.ravel(), minlength=count) / sizes
        along = supported & (mean_motion > _BACKGROUND_MOTION)
        supported = along if along.any() else supported
    kept = supported[labels]
    _, labels = cv2.connectedComponents((~kept).astype(np.uint8), connectivity=4)
    pinhole = np.bincount(labels.ravel()) < 0.02 * area
    pinhole[0] = False
    return kept | pinhole[labels]


def _disc(radius: float) -> NDArray[np.uint8]:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * max(round(radius), 1) + 1,) * 2)
