"""Sides that turn into view: what moves with the object, lies against it, and was not beside it in the beginning."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.evidence.colours import relative_distance
from tracking3d.evidence.moving_along import HALF_PATCH
from tracking3d.trackers.colour_models import histograms, log_ratio

MOVES = 0.35
_DISPUTED = 2.0  # log-odds
_CLOSED = 0.1  # of the root of the area: gaps between what moves along, which is seen where there are edges
_DENSE = 0.2  # share of a part in which motion is seen
_SURROUNDINGS = -1.0  # of `unlike_surroundings`, below which a colour is of them
_REACH = 0.15  # of the root of the area, in one frame
_STILL, _FEWEST = 0.5, 0.01  # shares of what can be told beside it, and of the window that tell at least
_FAR, _RARE = 0.25, 0.002
_TAKEN = 3.0  # log-odds


def taken_in(
    log_odds: NDArray[np.float32],
    initial: NDArray[np.bool_],
    rendered: NDArray[np.bool_],
    moving: NDArray[np.float32],
    strange: NDArray[np.float32],
) -> NDArray[np.float32]:
    """``(S, S)`` log-odds with what motion says: where both masks differ, and of parts beside both that move along.

    Args:
        log_odds: ``(S, S)`` so far.
        initial: ``(S, S)`` the mask tracker's mask.
        rendered: ``(S, S)`` the silhouette.
        moving: ``(S, S)`` from `tracking3d.evidence.moving_along`.
        strange: ``(S, S)`` from `unlike_surroundings`.
    """
    known = initial | rendered
    distance = relative_distance(known)
    if _still(moving, distance):
        return log_odds
    log_odds = log_odds + np.where(initial ^ rendered, _DISPUTED * moving, 0)
    root = math.sqrt(max(int(np.count_nonzero(known)), 1))
    seen = (moving > MOVES) & (strange > _SURROUNDINGS) & ~known
    closed = cv2.morphologyEx((seen | known).astype(np.uint8), cv2.MORPH_CLOSE, _disc(_CLOSED * root))
    # A patch that reaches over the outline moves along with what it has of the object.
    closed = cv2.erode(closed, _disc(HALF_PATCH * len(known) / 2)) > 0
    added = closed & (distance > -_REACH) & ~known & (moving > -MOVES) & (strange > _SURROUNDINGS)
    added = _touching(_seen_parts(added, seen), known)
    return np.where(added, np.maximum(log_odds, _TAKEN), log_odds).astype(np.float32)


def vouched(
    mask: NDArray[np.bool_], initial: NDArray[np.bool_], moving: NDArray[np.float32]
) -> float:
    """Share of a mask ``(S, S)`` by which it differs from the initial one where motion says so."""
    more = _seen_parts(mask & ~initial, moving > MOVES)
    less = _seen_parts(initial & ~mask, moving < -MOVES)
    return int(np.count_nonzero(more | less)) / max(int(np.count_nonzero(mask)), 1)


def _seen_parts(where: NDArray[np.bool_], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(S, S)`` the connected parts in which enough is seen of a motion."""
    count, part = cv2.connectedComponents(where.astype(np.uint8))
    dense = np.bincount(part[seen], minlength=count) >= _DENSE * np.bincount(part.ravel(), minlength=count)
    dense[0] = False
    return np.asarray(dense[part])


def _touching(where: NDArray[np.bool_], known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(S, S)`` the connected parts that lie against what is known."""
    _, part = cv2.connectedComponents(where.astype(np.uint8))
    beside = np.unique(part[cv2.dilate(known.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0])
    return np.isin(part, beside) & where


def _disc(radius: float) -> NDArray[np.uint8]:
    side = 2 * max(round(radius), 1) + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)).astype(np.uint8)


def _still(moving: NDArray[np.float32], distance: NDArray[np.float32]) -> bool:
    """Whether most of what lies well beside the object moves as it does: it stands there, and the camera moves."""
    well_beside = distance < -_REACH
    along, stays = (np.count_nonzero(one & well_beside) for one in (moving > MOVES, moving < -MOVES))
    return along > _STILL * max(along + stays, _FEWEST * moving.size)


def unlike_surroundings(lab: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """``(S, S)`` log of how rare a colour is well beside the object: an arm goes on where the object has ended."""
    distance = relative_distance(known)
    far = distance < -_FAR
    if not far.any():
        return np.zeros(known.shape, np.float32)
    return log_ratio(histograms(lab, known, far), lab, _RARE)
