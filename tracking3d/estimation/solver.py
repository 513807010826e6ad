"""The protocol of solvers: state machines from frames and rough masks to estimates.

``init`` starts on the first frame, ``step`` takes each further one, ``result`` gives the object. Failure is
data: a frame that cannot be estimated is answered with a status and a reason, never with an exception.
"""

from __future__ import annotations

from typing import Generic, Protocol, TypeVar

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel
from tracking3d.frames import Frame, MaskEstimate

State = TypeVar("State")


class Solver(Protocol, Generic[State]):
    """Estimates shape, texture and poses causally; all memory is in the state it hands back."""

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[State, FrameEstimate]:
        """Start on the first frame; its mask is given."""
        ...

    def step(self, state: State, frame: Frame, mask: MaskEstimate) -> tuple[State, FrameEstimate]:
        """Take one more frame."""
        ...

    def result(self, state: State) -> ObjectModel:
        """The object as it is known now."""
        ...
