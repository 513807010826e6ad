"""Sides that turn into view: what moves with the object and lies against it becomes part of it.

Motion shows where there are edges, and goes over the object's own outline by up to half a patch; so gaps are closed and
the outermost is taken off again. An arm that holds the object moves along as well, but goes on beyond it: what has a
colour that is seen well beside the object, too, is left out.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.segmentation.colour_models import relative_distance
from tracking3d.segmentation.online_motion_cue import PATCH
from tracking3d.trackers.colour_models import histograms, log_ratio

MOVES = 0.35
"""Of what `tracking3d.segmentation.online_motion_cue` says, from which on something does."""
_DISPUTED, _TAKEN = 2.0, 3.0  # log-odds: of motion where the masks differ, and of what is taken in
_CLOSED = 0.1  # of the root of the area: gaps between what moves along, which is seen where there are edges
_DENSE = 0.2  # share of a part in which motion is seen
_SURROUNDINGS = -1.0  # of `unlike_surroundings`, below which a colour is of them
_REACH = 0.15  # of the root of the area, in one frame
_FAR = 0.25  # of the root of the area, from which on something lies well beside the object
_RARE = 0.002  # share of the surroundings that a colour needs to be theirs


def grow_region(
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
        moving: ``(S, S)`` from `tracking3d.segmentation.online_motion_cue`.
        strange: ``(S, S)`` from `unlike_surroundings`.
    """
    known = initial | rendered
    log_odds = log_odds + np.where(initial ^ rendered, _DISPUTED * moving, 0)
    root = math.sqrt(max(int(np.count_nonzero(known)), 1))
    seen = (moving > MOVES) & (strange > _SURROUNDINGS) & ~known
    closed = cv2.morphologyEx((seen | known).astype(np.uint8), cv2.MORPH_CLOSE, _disc(_CLOSED * root))
    # A patch that reaches over the outline moves along with what it has of the object.
    closed = cv2.erode(closed, _disc(PATCH * len(known) / 4)) > 0
    added = closed & ~known & (moving > -MOVES) & (strange > _SURROUNDINGS)
    added = _touching(_visible_parts(added, seen), known) & (relative_distance(known) > -_REACH)
    return np.where(added, np.maximum(log_odds, _TAKEN), log_odds).astype(np.float32)


def motion_supported_share(
    mask: NDArray[np.bool_], initial: NDArray[np.bool_], moving: NDArray[np.float32]
) -> float:
    """Share of a mask ``(S, S)`` by which it differs from the initial one where motion says so."""
    more = _visible_parts(mask & ~initial, moving > MOVES)
    less = _visible_parts(initial & ~mask, moving < -MOVES)
    return int(np.count_nonzero(more | less)) / max(int(np.count_nonzero(mask)), 1)


def _visible_parts(where: NDArray[np.bool_], seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
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


def unlike_surroundings(lab: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """``(S, S)`` log of how rare a colour is well beside the object: an arm goes on where the object has ended."""
    distance = relative_distance(known)
    far = distance < -_FAR
    if not far.any():
        return np.zeros(known.shape, np.float32)
    return log_ratio(histograms(lab, known, far), lab, _RARE)
