"""Mask tracker ``flow``: optical flow, colours and motion carry the mask; no box tracker leads it."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.csrt import BoxTracker, CsrtTracker
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import ColourSegmentation, Cues


class FlowTracker:
    """Mask tracker ``flow``."""

    class Options(Options):
        """Options of ``flow``."""

        witness: Literal["none", "csrt"] = Field("none", description="Box tracker.")
        segmentation_size: int = Field(224, ge=64, le=1024, description="Side of the crop in pixels.")
        prior: float = Field(1.5, ge=0, description="Weight of the moved mask's outline.")
        global_colours: float = Field(1.0, ge=0, description="Weight of remembered colours.")
        local_colours: float = Field(1.0, ge=0, description="Weight of colours nearby.")
        motion: float = Field(2.0, ge=0, description="Weight of motion.")
        witness_weight: float = Field(1.0, ge=0, description="Weight of witness.")
        change: float = Field(0.0, ge=0, description="Weight of change.")
        similarity: bool = Field(True, description="similarity")
        smoother: bool = Field(True, description="smoother")

    def __init__(self, options: FlowTracker.Options) -> None:
        self._options = options
        self._segmentation: ColourSegmentation | None = None

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from its validated options."""
        if not isinstance(options, FlowTracker.Options):
            raise PluginError("The tracker flow was built with options that are not its own.")
        return cls(options)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a box or a mask; the prompt's mask is the first answer, else the box's segmentation."""
        if clip_box(prompt.box, frame.image.shape) is None:
            raise InputError(
                f"The box {prompt.box} lies outside {frame.name or 'the first frame'}; give a box inside it."
            )
        o = self._options
        self._segmentation = ColourSegmentation(
            frame.image,
            prompt.box,
            prompt.mask,
            o.segmentation_size,
            Cues(
                o.prior,
                o.global_colours,
                o.local_colours,
                o.motion,
                o.witness_weight,
                o.similarity,
                o.smoother,
            ),
        )
        self._boxes = (
            BoxTracker(CsrtTracker.Options(), frame.image, prompt.box) if o.witness == "csrt" else None
        )
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Answer for the next frame."""
        if self._segmentation is None:
            raise PluginError("The tracker flow was asked for a frame before it was started with init.")
        box = self._boxes.update(frame.image) if self._boxes else None
        return self._segmentation.step(frame.image, box)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``frame``."""
        box = box_of(mask)
        if box is None or self._segmentation is None:
            return
        self._segmentation.correct(frame.image, mask)
