"""Confidence of a mask without ground truth.

Agreement with one's own prediction says nothing, since a stuck mask agrees with itself; what tells is an
independent box, and whether colours and motion support the outline.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.runtime.logistic_model import LogisticModel
from tracking3d.trackers.outline import inside_distance

_BAND = 0.08  # width of the bands along the outline, relative to the square root of the area
_LOST_SEPARATION = 0.1
_LOST_AGREEMENT = 0.3
_USUAL_AGREEMENT = 0.75  # used if there is no box tracker
_MODEL = LogisticModel.load("mask_score")


@dataclass(frozen=True)
class Judgement:
    """What tells a good mask from a bad one."""

    # how much better than its surroundings the mask fits the first frame's colours, in [-1, 1]
    separation: float
    # the same just inside and outside the outline, by all the evidence but the prior, in [-1, 1]
    margin: float
    agreement: float | None = None  # IoU of the mask's box and the box tracker's; None without a box tracker
    believed: bool = True  # false if the propagated last mask replaces a segmentation that changed too much

    @property
    def score(self) -> float:
        """The chance that the mask's IoU with the truth is at least 0.7.

        Strong colours do not outweigh a box that disagrees.
        """
        agreement = _USUAL_AGREEMENT if self.agreement is None else self.agreement
        features = {"agreement": agreement, "margin": self.margin, "separation": self.separation}
        return _MODEL.probability(features)

    @property
    def doubt(self) -> str:
        """Why the mask may be lost, or empty."""
        if self.agreement is not None and self.agreement < _LOST_AGREEMENT:
            return "the mask and the box tracker disagree"
        if self.separation < _LOST_SEPARATION:
            return "the mask's colours do not match the object"
        return "" if self.believed else "the segmentation changed too much; the last mask was propagated"


def outline_margin(evidence: NDArray[np.float32], mask: NDArray[np.bool_]) -> float:
    """How much more the evidence speaks for the object just inside the outline than just outside, in [-1, 1].

    Args:
        evidence: ``(S, S)`` log-odds of the object.
        mask: ``(S, S)``.
    """
    distance = inside_distance(mask)
    band = np.abs(distance) <= max(_BAND * math.sqrt(np.count_nonzero(mask)), 1.0)
    inner, outer = band & mask, band & ~mask
    if not inner.any() or not outer.any():
        return 0.0
    likeness = np.tanh(evidence / 3)
    return float(likeness[inner].mean() - likeness[outer].mean()) / 2
