"""The protocol of mask trackers: 2D trackers that give a rough mask of the object in every frame.

A plug-in is a class registered under the entry-point group ``tracking3d.trackers``. It knows frames and
masks, never the pipeline.
"""

from __future__ import annotations

from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from tracking3d.frames import Frame, MaskEstimate, Prompt


class Options(BaseModel):
    """Base of every plug-in's options: frozen, and unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@runtime_checkable
class MaskTracker(Protocol):
    """Gives a mask of the object in every frame, causally.

    A class that implements it has a nested pydantic model ``Options`` and a classmethod
    ``from_options(options)``; YAML and ``--set`` are checked by that model.
    """

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build a tracker from its validated ``Options``."""
        ...

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame from a box or a mask, and estimate the mask in that frame."""
        ...

    def step(self, frame: Frame) -> MaskEstimate:
        """Estimate the mask in the next frame."""
        ...


@runtime_checkable
class CorrectableTracker(Protocol):
    """A mask tracker that can be re-anchored on a better mask."""

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Take ``mask`` ``(H, W)`` as the object's place in ``frame``."""
        ...


@runtime_checkable
class ForewarnedTracker(Protocol):
    """A mask tracker that can begin with a frame while the estimate for the one before is still worked on."""

    def announce(self, frame: Frame) -> None:
        """``step`` will be called with ``frame`` next, if at all; a correction may come before."""
        ...


@runtime_checkable
class SparingTracker(Protocol):
    """A mask tracker that need not be asked in every frame."""

    def skip(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Take ``mask`` ``(H, W)`` as the object's place in the next frame, in place of ``step``."""
        ...


@runtime_checkable
class ResumableTracker(Protocol):
    """A mask tracker that can be asked for its memory, and be given it again in another process.

    A stopped run can be resumed without it too: the tracker then runs through the frames again, which gives the same
    result if it is deterministic, but takes as long as before.
    """

    def state(self) -> Any:
        """All that later estimates depend on, besides the first frame: numpy arrays, lists, dicts and plain values.

        A returned state never changes afterwards.
        """
        ...

    def restore(self, frame: Frame, prompt: Prompt, state: Any) -> None:
        """Restore ``state``; ``frame`` and ``prompt`` are those that ``init`` was given."""
        ...
