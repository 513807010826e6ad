"""How far a refined estimate can be trusted, given its landmarks.

The rendering at a pose can look right though the pose is wrong, because shape and texture were made with such poses.
At a wrong pose fewer of the matched landmarks are inliers. But landmarks have made the poses that they agree with:
those of a map that is wrong as a whole agree with each other. So they can lower a confidence, and never raise it.
"""

from __future__ import annotations

import math

from tracking3d.estimation.estimate import Assessment, Status
from tracking3d.frames import TRACKED_CONFIDENCE
from tracking3d.points.landmark_adjustment import LandmarkSupport
from tracking3d.results.records import FrameRecord

_EVEN, _NEARLY_ALL = 0.5, 0.95
"""Shares of the followed landmarks that agree, between which belief grows: if poses are wrong, what is followed is
often something else, such as the background, and much of it fits no pose."""
_ENOUGH = 30
"""Landmark inliers from which on more of them add nothing."""
_INTERCEPT = -1.48
_TERMS = {  # weight, and the range that was seen
    "rendering": (1.01, -1.62, 4.11),
    "share": (0.366, 0.0, math.log(_NEARLY_ALL / (1 - _NEARLY_ALL))),
    "landmarks": (0.191, 0.0, math.log1p(_ENOUGH)),
}


def assess_estimate(estimate: FrameRecord, support: LandmarkSupport) -> tuple[Assessment, dict[str, float]]:
    """The assessment of a refined estimate, and what it comes from, for the estimate's ``diagnostics``."""
    assessment = Assessment(estimate.status, estimate.reason, estimate.confidence)
    if estimate.free_axis is None:  # no landmark rotates with a surface that looks the same from all sides
        assessment = judge_with_landmarks(assessment, support)
    return assessment, {
        "confidence_before": estimate.confidence,
        "landmark_inliers": float(support.agreeing),
        "landmark_matches": float(support.followed),
    }


def judge_with_landmarks(rendering: Assessment, support: LandmarkSupport) -> Assessment:
    """The assessment of a frame by its rendering and its landmarks; a lost frame stays lost.

    The confidence is that of the rendering, or a lower one that the landmarks give. The latter is a logistic regression
    of whether the estimate is right, that is, within 10 degrees and above IoU 0.7. It was fitted to synthetic suites
    and one real clip; history/pages/method/confidence.md says which, and what it is worth on others. A plain object
    has no landmarks, and keeps the confidence of its rendering.

    Args:
        rendering: The judgement by what is rendered, and by points that were followed from frame to frame.
        support: What landmarks say.
    """
    if rendering.status is Status.LOST:
        return rendering
    evidence = refined_confidence_features(rendering.confidence, support)
    odds = sum(weight * min(max(evidence[name], low), high) for name, (weight, low, high) in _TERMS.items())
    confidence = min(rendering.confidence, 1 / (1 + math.exp(-_INTERCEPT - odds)))
    if confidence >= TRACKED_CONFIDENCE:
        return Assessment(Status.TRACKED, "", confidence)
    reason = rendering.reason
    if rendering.status is Status.TRACKED or not reason:
        reason = f"too few landmark inliers ({support.agreeing} of {support.followed} matched landmarks)"
    return Assessment(Status.UNCERTAIN, reason, confidence)


def refined_confidence_features(rendering: float, support: LandmarkSupport) -> dict[str, float]:
    """The evidence that a confidence is made of, by name.

    Args:
        rendering: The confidence by what is rendered.
        support: What landmarks say.
    """
    share = (1 + support.agreeing) / (2 + support.followed)
    return {
        "rendering": _log_odds(min(max(rendering, 0.01), 0.99)),
        "share": _log_odds(min(max(share, _EVEN), _NEARLY_ALL)),
        "landmarks": math.log1p(min(support.agreeing, _ENOUGH)),
    }


def _log_odds(probability: float) -> float:
    return math.log(probability / (1 - probability))
