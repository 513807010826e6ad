"""OSTrack (Ye et al., ECCV 2022) with AlphaRefine (Yan et al., CVPR 2021) as a tracking3d plug-in."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.features.networks.store import find_network
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.protocol import CorrectableTracker, MaskTracker, Options
from tracking3d_ostrack.network import OsTrackBoxes
from tracking3d_ostrack.refinement import AlphaRefine
from tracking3d_ostrack.results import open_results
from tracking3d_ostrack.tracking import NetworkTracker


class OsTracker:
    """Mask tracker ``ostrack``. It fulfils the protocol ``tracking3d.trackers.protocol.MaskTracker``.

    Args:
        tracker: What answers: the networks or the results.
    """

    class Options(Options):
        """What can be set in YAML under ``tracker:`` or with ``--set tracker.<name>=...``."""

        model: str | None = Field(None, description="ONNX export of OSTrack, or name of a known network.")
        refinement: str | None = Field(
            None,
            description="ONNX export of AlphaRefine; without it the colour segmentation makes the masks.",
        )
        results: str | None = Field(
            None,
            description="What the projects have written: a text file with a box or mask a frame, or masks.",
        )
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the networks.")

    def __init__(self, tracker: MaskTracker) -> None:
        self._tracker = tracker

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Load the networks or open the results.

        Raises:
            InputError: If not one of the two is given, or it cannot be used.
        """
        given = cls.Options.model_validate(options.model_dump())
        if (given.model is None) == (given.results is None):
            raise InputError(
                "ostrack needs either an ONNX export (--set tracker.model=FILE) or what OSTrack has written (--set "
                "tracker.results=PATH); give one of the two."
            )
        if given.results is not None:
            return cls(open_results(Path(given.results).expanduser()))
        boxes = OsTrackBoxes(Network(find_network(given.model or ""), given.threads))
        if given.refinement is None:
            return cls(NetworkTracker(boxes))
        return cls(NetworkTracker(boxes, AlphaRefine(Network(find_network(given.refinement), given.threads))))

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame."""
        return self._tracker.init(frame, prompt)

    def step(self, frame: Frame) -> MaskEstimate:
        """Answer for the next frame."""
        return self._tracker.step(frame)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``frame``; results that are written stay as they are."""
        if isinstance(self._tracker, CorrectableTracker):
            self._tracker.correct(frame, mask)
