"""Mask tracker ``flow``: optical flow, colours, motion and background carry the mask; no box leads it."""

from __future__ import annotations

from dataclasses import fields
from typing import Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt
from tracking3d.trackers.box_trackers import OpenCvBoxes
from tracking3d.trackers.crops import box_iou, box_of, clip_box
from tracking3d.trackers.csrt import STRAYED, BoxTracker, CsrtTracker
from tracking3d.trackers.cues import Cues
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import SMOOTHER, ColourSegmentation

_CUES = Cues()
_WITNESSES = {"csrt": "TrackerCSRT", "kcf": "TrackerKCF"}  # in OpenCV's contrib modules


class FlowTracker:
    """Mask tracker ``flow``: the segmentation of ``csrt`` without a box tracker, or with one as witness only.

    Every cue has a weight of its own; 0 switches it off. An object that leaves the frame is answered with no mask
    and found again by its colours.
    """

    class Options(Options):
        """Options of ``flow``."""

        segmentation_size: int = Field(
            224, ge=64, le=1024, description="Side of the segmentation's crop in pixels."
        )
        prior: float = Field(
            _CUES.prior, ge=0, le=100, description="Weight of the distance to the outline of the moved mask."
        )
        outline: float = Field(
            _CUES.outline, ge=0, le=100, description="Weight in the prior of the last outline, shifted only."
        )
        similarity: bool = Field(
            _CUES.similarity,
            description="Prior also by one similarity, fitted to the flow that forward and backward agree on.",
        )
        global_colours: float = Field(
            _CUES.global_colours, ge=0, le=100, description="Weight of remembered colours."
        )
        local_colours: float = Field(
            _CUES.local_colours, ge=0, le=100, description="Weight of colours nearby, one frame ago."
        )
        motion: float = Field(
            _CUES.motion, ge=0, le=100, description="Weight of motion with the object or the background."
        )
        background: float = Field(
            _CUES.background, ge=0, le=100, description="Weight of change against the remembered background."
        )
        novelty: float = Field(
            _CUES.novelty, ge=0, le=100, description="Weight of never seen colours within the outline."
        )
        smoother: bool = Field(
            _CUES.smoother, description="Smooth the evidence along the edges of the image."
        )
        witness: Literal["none", "csrt", "kcf"] = Field(
            "none", description="Box tracker that judges the mask and helps where it is lost."
        )
        witness_weight: float = Field(
            _CUES.witness, ge=0, le=100, description="Weight of the distance beyond the witness's box."
        )

    def __init__(self, options: FlowTracker.Options) -> None:
        self._options = options
        self._segmentation: ColourSegmentation | None = None
        self._witness: OpenCvBoxes | None = None
        self._witnessed: Box | None = None

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from its validated options."""
        if not isinstance(options, FlowTracker.Options):
            raise PluginError("The tracker flow was built with options that are not its own.")
        witness = _WITNESSES.get(options.witness)
        if witness and (why := why_no_contrib(witness)):
            raise PluginError(f"The witness {options.witness} of the tracker flow cannot be used: {why}.")
        return cls(options)

    @classmethod
    def why_unavailable(cls) -> str:
        """What the OpenCV in use lacks for this tracker; empty where it lacks nothing."""
        return why_no_contrib(SMOOTHER)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a box or a mask; the prompt's mask is the first answer, else the box's segmentation."""
        if clip_box(prompt.box, frame.image.shape) is None:
            raise InputError(
                f"The box {prompt.box} lies outside {frame.name or 'the first frame'}; give a box inside it."
            )
        options = self._options
        weights = {one.name: getattr(options, one.name) for one in fields(Cues) if one.name != "witness"}
        cues = Cues(**weights, witness=options.witness_weight)
        self._segmentation = ColourSegmentation(
            frame.image, prompt.box, prompt.mask, size=options.segmentation_size, cues=cues
        )
        self._witness = _witness(options.witness, frame.image, prompt.box)
        self._witnessed = prompt.box
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Answer for the next frame."""
        if self._segmentation is None:
            raise PluginError("The tracker flow was asked for a frame before it was started with init.")
        self._witnessed = self._witness.update(frame.image) if self._witness else None
        return self._segmentation.step(frame.image, self._witnessed)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``frame``, the witness too if it has strayed."""
        box = box_of(mask)
        if box is None or self._segmentation is None:
            return
        self._segmentation.correct(frame.image, mask)
        if self._witnessed is None or box_iou(self._witnessed, box) < STRAYED:
            self._witness, self._witnessed = _witness(self._options.witness, frame.image, box), box


def _witness(name: str, image: Image, box: Box) -> OpenCvBoxes | None:
    if name == "csrt":
        return BoxTracker(CsrtTracker.Options(), image, box)
    return OpenCvBoxes(cv2.TrackerKCF.create(), image, box) if name == "kcf" else None
