"""D3S (Lukezic et al., CVPR 2020) as a tracking3d plug-in: its segmentation network, or results it has written."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError
from tracking3d.features.networks.session import Network
from tracking3d.features.networks.store import find_network
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.protocol import CorrectableTracker, MaskTracker, Options
from tracking3d_d3s.network import D3sNetwork
from tracking3d_d3s.results import open_results


class D3sTracker:
    """Mask tracker ``d3s``. It fulfils the protocol ``tracking3d.trackers.protocol.MaskTracker``.

    Args:
        tracker: What answers: the network or the results.
    """

    class Options(Options):
        """What can be set in YAML under ``tracker:`` or with ``--set tracker.<name>=...``."""

        model: str | None = Field(None, description="ONNX export of D3S, or name of a known network.")
        results: str | None = Field(
            None, description="What D3S has written: a folder of masks, or a text file with a region a frame."
        )
        position: Literal["filter", "mask"] = Field(
            "filter",
            description="Where the network looks: where CSR-DCF finds the object, or the last mask was.",
        )
        threshold: float = Field(
            0.5, gt=0, lt=1, description="Probability above which a pixel is the object."
        )
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the network.")

    def __init__(self, tracker: MaskTracker) -> None:
        self._tracker = tracker

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Load the network or open the results.

        Raises:
            InputError: If not one of the two is given, or it cannot be used.
        """
        given = cls.Options.model_validate(options.model_dump())
        if (given.model is None) == (given.results is None):
            raise InputError(
                "d3s needs either an ONNX export (--set tracker.model=FILE) or what D3S has written (--set "
                "tracker.results=PATH); give one of the two."
            )
        if given.results is not None:
            return cls(open_results(Path(given.results).expanduser()))
        network = Network(find_network(given.model or ""), given.threads)
        return cls(D3sNetwork(network, given.threshold, follow_filter=given.position == "filter"))

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
