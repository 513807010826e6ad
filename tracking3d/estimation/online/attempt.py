"""A frame with the best pose that was found for it, and how far that is believed."""

from __future__ import annotations

from dataclasses import dataclass

from tracking3d.estimation.assessment import Assessment
from tracking3d.estimation.estimate import Status
from tracking3d.estimation.online.belief import View
from tracking3d.estimation.online.judgement import BELIEVED, Support
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.pose_refinement_types import PoseFit


@dataclass(frozen=True, eq=False)
class Attempt:
    """What came of looking for the object in a frame.

    Attributes:
        view: The frame.
        fit: Its pose.
        won: Which start of the pose won.
        points: Those that agree with it.
        support: What speaks for the pose beside its losses.
        judgement: Of the pose.
    """

    view: View
    fit: PoseFit
    won: str
    points: FollowedPoints
    support: Support
    judgement: Assessment

    @property
    def lost(self) -> bool:
        """Whether the pose is not believed."""
        return self.judgement.status is Status.LOST

    @property
    def doubtful(self) -> bool:
        """Whether it is lost, or hardly believed."""
        return self.judgement.confidence < BELIEVED

    def better_than(self, other: Attempt) -> bool:
        """Whether more points agree with it and the pixels fit better; any pose is better than none."""
        return other.lost or (
            self.support.witnesses > other.support.witnesses and self.fit.appearance < other.fit.appearance
        )
