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
from tracking3d.runtime.logistic_model import LogisticModel

_EVEN, _NEARLY_ALL = 0.5, 0.95
"""Shares of the followed landmarks that agree, between which belief grows: if poses are wrong, what is followed is
often something else, such as the background, and much of it fits no pose."""
_ENOUGH = 30
"""Landmark inliers from which on more of them add nothing."""
_MODEL = LogisticModel.load("refined_confidence")


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

    The confidence is that of the rendering, or a lower one that the landmarks give, see
    history/pages/method/confidence.md. A plain object has no landmarks, and keeps the confidence of its rendering.

    Args:
        rendering: The judgement by what is rendered, and by points that were followed from frame to frame.
        support: What landmarks say.
    """
    if rendering.status is Status.LOST:
        return rendering
    evidence = refined_confidence_features(rendering.confidence, support)
    confidence = min(rendering.confidence, _MODEL.probability(evidence))
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
