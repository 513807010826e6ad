"""The order in which a solver is shown the frames, where it is not that of time: forwards, and then backwards."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Frame


@dataclass(frozen=True)
class FrameOrder:
    """Frames numbered in the order in which they are shown.

    A solver takes frames for one after the other and counts the time between them by their indices. Frames from
    before the first one come when the last one is done; they are numbered on from there, so that time goes on.

    Attributes:
        first: Index of the frame that was shown first.
        last: Index of the last one that was shown forwards; None while frames still are.
    """

    first: int
    last: int | None = None

    def number(self, frame: Frame) -> Frame:
        """The frame as the solver is shown it."""
        if self.last is None or frame.index >= self.first:
            return frame
        return replace(frame, index=self.last + self.first - frame.index)

    def index(self, estimate: FrameEstimate) -> FrameEstimate:
        """The solver's answer, and those that it revises, under their frames' own indices."""
        if self.last is None:
            return estimate
        revised = tuple(map(self.index, estimate.revised))
        index = estimate.index
        if index > self.last:
            index = self.last + self.first - index
        return replace(estimate, index=index, revised=revised)
