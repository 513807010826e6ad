"""The order in which a solver gets the frames, if it is not that of time: forwards, and then backwards."""

from __future__ import annotations

from dataclasses import dataclass, replace

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Frame


@dataclass(frozen=True)
class FrameOrder:
    """Frames numbered in the order in which they are shown.

    A solver takes frames for one after the other and counts the time between them by their indices. Frames from
    before the first one come when the last one is done; they are numbered on from there, so that time increases.
    """

    first: int  # index of the first frame
    last: int | None = None  # index of the last frame forwards; None until it is known

    def number_of(self, index: int) -> int:
        """The number of the frame with an index."""
        if self.last is None or index >= self.first:
            return index
        return self.last + self.first - index

    def number(self, frame: Frame) -> Frame:
        """The frame as the solver is shown it."""
        return replace(frame, index=self.number_of(frame.index))

    def index(self, estimate: FrameEstimate) -> FrameEstimate:
        """The solver's estimate, and those that it revises, under their frames' own indices."""
        if self.last is None:
            return estimate
        revised = tuple(map(self.index, estimate.revised))
        index = estimate.index
        if index > self.last:
            index = self.last + self.first - index
        return replace(estimate, index=index, revised=revised)
