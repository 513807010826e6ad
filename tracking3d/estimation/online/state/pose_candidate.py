"""A frame with the best pose that was found for it, and how far that is believed."""

from __future__ import annotations

from dataclasses import dataclass

from tracking3d.estimation.assessment import Assessment
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.optimization.types import PoseFit
from tracking3d.estimation.online.state.confidence import BELIEVED, PoseEvidence
from tracking3d.estimation.online.state.object_map import Keyframe


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """What came of looking for the object in a frame.

    Attributes:
        view: The frame.
        fit: Its pose.
        hypothesis: Which start of the pose won.
        points: Those that agree with it.
        evidence: What speaks for the pose beside its losses.
        assessment: Of the pose.
    """

    view: Keyframe
    fit: PoseFit
    hypothesis: str
    points: FollowedPoints
    evidence: PoseEvidence
    assessment: Assessment

    @property
    def lost(self) -> bool:
        """Whether the pose is not believed."""
        return self.assessment.status is Status.LOST

    @property
    def doubtful(self) -> bool:
        """Whether it is lost, or hardly believed."""
        return self.assessment.confidence < BELIEVED

    def better_than(self, other: PoseCandidate) -> bool:
        """Whether more points agree with it and the pixels fit better; any pose is better than none."""
        return other.lost or (
            self.evidence.inliers > other.evidence.inliers and self.fit.appearance < other.fit.appearance
        )
