"""Sides that turn into view: what moves with the object, lies against it, and was not beside it in the beginning."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.evidence.colours import relative_distance
from tracking3d.evidence.moving_along import HALF_PATCH
from tracking3d.trackers.colour_models import histograms, log_ratio

_MOVES, _STAYS = 0.35, -0.3
_CLOSED = 0.1  # of the root of the area: gaps between what moves along, which is seen where there are edges
_DENSE = 0.2  # share of a part in which motion is seen
_BACKGROUND = -1.0  # log of the colours' ratio in the first frame, below which it is of the surroundings
_REACH = 0.15  # of the root of the area, in one frame
_STILL, _FEWEST = 0.5, 0.01  # shares of what can be told beside it, and of the window that tell at least
_FAR, _RARE = 0.25, 0.002
_TAKEN = 3.0  # log-odds


def taken_in(
    log_odds: NDArray[np.float32],
    known: NDArray[np.bool_],
    moving: NDArray[np.float32],
    first: NDArray[np.float32],
) -> tuple[NDArray[np.float32], float]:
    """``(S, S)`` log-odds with the parts beside the object that move with it, and their share of the whole.

    Args:
        log_odds: ``(S, S)`` so far.
        known: ``(S, S)`` where the object is known to be.
        moving: ``(S, S)`` from `tracking3d.evidence.moving_along`.
        first: ``(S, S)`` log of how likely the colours are the object's by what the first frame showed.
    """
    root = math.sqrt(max(int(np.count_nonzero(known)), 1))
    strange = first > _BACKGROUND
    distance = relative_distance(known)
    seen = (moving > _MOVES) & strange & ~known
    radius = max(round(_CLOSED * root), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    if _still(moving, distance):
        return log_odds, 0.0
    closed = cv2.morphologyEx((seen | known).astype(np.uint8), cv2.MORPH_CLOSE, disc)
    # A patch that reaches over the outline moves along with what it has of the object.
    over = 2 * max(round(HALF_PATCH * len(known)), 1) + 1
    closed = cv2.erode(closed, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (over, over))) > 0
    near = distance > -_REACH
    added = closed & near & ~known & (moving > _STAYS) & strange
    count, part = cv2.connectedComponents(added.astype(np.uint8))
    touching = np.unique(part[cv2.dilate(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0])
    dense = np.bincount(part[seen], minlength=count) >= _DENSE * np.bincount(part.ravel(), minlength=count)
    dense &= np.isin(np.arange(count), touching)
    dense[0] = False
    into = dense[part]
    share = float(np.count_nonzero(into)) / max(int(np.count_nonzero(into | known)), 1)
    return np.where(into, np.maximum(log_odds, _TAKEN), log_odds).astype(np.float32), share


def _still(moving: NDArray[np.float32], distance: NDArray[np.float32]) -> bool:
    """Whether most of what lies well beside the object moves as it does: it stands there, and the camera moves."""
    well_beside = distance < -_REACH
    along, stays = (np.count_nonzero(one & well_beside) for one in (moving > _MOVES, moving < -_MOVES))
    return along > _STILL * max(along + stays, _FEWEST * moving.size)


def unlike_surroundings(lab: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """``(S, S)`` log of how rare a colour is well beside the object: an arm goes on where the object has ended."""
    distance = relative_distance(known)
    far = distance < -_FAR
    if not far.any():
        return np.zeros(known.shape, np.float32)
    return log_ratio(histograms(lab, known, far), lab, _RARE)
