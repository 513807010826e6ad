"""MobileSAM (Zhang et al. 2023) as a mask tracker: an example of a tracking3d plug-in that builds on a built-in.

The tracker ``onnx`` of tracking3d does the work; this one chooses its network and its defaults, and shows how
little a tracker of your own network needs.
"""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.onnx.tracker import OnnxTracker
from tracking3d.trackers.protocol import Options


class SamTracker:
    """Mask tracker ``sam``: box, centre, holes and the last mask are the prompts, colours and box the judges."""

    class Options(Options):
        """What can be set in YAML under ``tracker:`` or with ``--set tracker.<name>=...``."""

        encoder: str = Field("mobile-sam-encoder", description="ONNX file or known name of the encoder.")
        decoder: str = Field("mobile-sam-decoder", description="The same of the prompt decoder.")
        box: Literal["nano", "csrt"] = Field(
            "nano", description="Box tracker: NanoTrack, or CSR-DCF, which needs no file."
        )
        nano_backbone: str = Field("nanotrack-backbone", description="NanoTrack's backbone, alike.")
        nano_head: str = Field("nanotrack-head", description="NanoTrack's head, alike.")
        every: int = Field(
            5, ge=1, le=1000, description="The encoder runs in every k-th frame, and in doubt."
        )
        threads: int = Field(1, ge=1, le=256, description="CPU threads of the networks.")

    def __init__(self, tracker: OnnxTracker) -> None:
        self._tracker = tracker

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from options that tracking3d has checked against ``Options``."""
        chosen = cls.Options.model_validate(options.model_dump())
        return cls(
            OnnxTracker.from_options(OnnxTracker.Options(segmenter="mobile-sam", **chosen.model_dump()))
        )

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame: the given mask, or the object segmented in the box."""
        return self._tracker.init(frame, prompt)

    def step(self, frame: Frame) -> MaskEstimate:
        """Answer for the next frame."""
        return self._tracker.step(frame)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from a better mask."""
        self._tracker.correct(frame, mask)
