"""The best pose found for a frame, and its confidence."""

from __future__ import annotations

from dataclasses import dataclass

from tracking3d.estimation.assessment import Assessment
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.optimization.types import PoseFit
from tracking3d.estimation.online.state.confidence import PoseEvidence
from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.frames import TRACKED_CONFIDENCE


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """The result of estimating the object's pose in a frame."""

    view: Keyframe  # the frame
    fit: PoseFit  # the pose and its losses
    hypothesis: str  # the name of the winning hypothesis
    points: FollowedPoints  # the pose's inliers
    evidence: PoseEvidence  # the evidence for the pose apart from its losses
    assessment: Assessment  # the pose's assessment

    @property
    def lost(self) -> bool:
        """Whether the pose is rejected."""
        return self.assessment.status is Status.LOST

    @property
    def doubtful(self) -> bool:
        """Whether the object is lost or the confidence is low."""
        return self.assessment.confidence < TRACKED_CONFIDENCE

    def better_than(self, other: PoseCandidate) -> bool:
        """Whether it has more inliers and a lower rendering cost; any pose is better than none."""
        return other.lost or (
            self.evidence.inliers > other.evidence.inliers and self.fit.appearance < other.fit.appearance
        )
