"""How far a pose redraws an initial mask: a doubtful one not at all. Behind an occluder the shape alone counts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import TRACKED_CONFIDENCE

_NO_WEIGHT, _FULL_WEIGHT = 0.5, 0.75
"""Confidence of a pose up to which it redraws nothing, and from which it has its say in full."""
_INITIAL_LOG_ODDS = 2.0
"""Log-odds of the pixels of an initial mask, and less those beside it, where it is weighed against a doubted pose."""

_MOST_BY_SHAPE, _AT_OUTLINE = 4.0, 0.02
"""Log-odds by a shape alone, and distance from its outline at which they saturate, over the root of the area."""


def pose_weight(confidence: float) -> float:
    """The weight of a pose's silhouette beside the initial mask, in [0, 1].

    Args:
        confidence: The confidence of the pose, in [0, 1].
    """
    return min(max((confidence - _NO_WEIGHT) / (_FULL_WEIGHT - _NO_WEIGHT), 0.0), 1.0)


def relative_confidence(confidence: float) -> float:
    """The confidence on the scale of the mask weights, which is one half where a frame just counts as tracked.

    The weights of the mask evidence were fitted with confidences of this scale.

    Args:
        confidence: The confidence of the pose, in [0, 1].
    """
    odds = confidence * (1 - TRACKED_CONFIDENCE)
    return odds / (odds + (1 - confidence) * TRACKED_CONFIDENCE)


def blend_with_initial(
    log_odds: NDArray[np.float32], initial: NDArray[np.bool_], weight: float
) -> NDArray[np.float32]:
    """``(S, S)`` log-odds in which the initial mask alone has the rest of the weight.

    Args:
        log_odds: ``(S, S)`` from silhouette, initial mask and image together.
        initial: ``(S, S)`` the mask tracker's mask.
        weight: Of ``log_odds``, in [0, 1]; see `pose_weight`.
    """
    if weight == 1:
        return log_odds
    alone = np.where(initial, _INITIAL_LOG_ODDS, -_INITIAL_LOG_ODDS)
    return np.asarray(weight * log_odds + (1 - weight) * alone, np.float32)


def shape_log_odds(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """``(S, S)`` log-odds of the object where the image cannot tell, because something is in front of it.

    Args:
        distance: ``(S, S)`` to the outline of its shape, over the root of the area, positive inside.
    """
    return np.asarray(_MOST_BY_SHAPE * np.tanh(distance / _AT_OUTLINE), np.float32)
