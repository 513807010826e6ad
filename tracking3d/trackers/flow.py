"""Mask tracker ``flow``: the mask is propagated by optical flow, colours, motion and background, without a leading
box."""

from __future__ import annotations

from dataclasses import fields
from typing import Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import PluginError
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt
from tracking3d.trackers.box_trackers import OpenCvBoxes
from tracking3d.trackers.crops import box_iou, box_of, check_box_in_frame
from tracking3d.trackers.csrt import STRAYED, BoxTracker, CsrtTracker
from tracking3d.trackers.cues import Cues, weight
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import SMOOTHER, ColourSegmentation

_CUES = Cues()
_BOX_TRACKERS = {"csrt": "TrackerCSRT", "kcf": "TrackerKCF"}  # in OpenCV's contrib modules


class FlowTracker:
    """Mask tracker ``flow``: the segmentation of ``csrt`` without a box tracker, or with one only to check the mask.

    Every cue has its own weight; 0 switches it off. While the object is outside the frame there is no mask; it is found
    again by its colours.
    """

    class Options(Options):
        """Options of ``flow``."""

        segmentation_size: int = Field(
            224, ge=64, le=1024, description="Side of the segmentation's crop in pixels."
        )
        prior: float = weight(_CUES.prior, "Weight of the distance to the outline of the moved mask.")
        outline: float = weight(_CUES.outline, "Weight in the prior of the last outline, only translated.")
        similarity: bool = Field(
            _CUES.similarity,
            description="Also use a prior from one similarity transform, fitted to consistent flow.",
        )
        global_colours: float = weight(
            _CUES.global_colours, "Weight of the object's and background's colour models."
        )
        local_colours: float = weight(_CUES.local_colours, "Weight of local colours in the previous frame.")
        motion: float = weight(_CUES.motion, "Weight of motion consistent with the object or the background.")
        background: float = weight(_CUES.background, "Weight of differences from the learnt background.")
        novelty: float = weight(_CUES.novelty, "Weight of unseen colours inside the outline.")
        smoother: bool = Field(_CUES.smoother, description="Smooth the log-odds along image edges.")
        witness: Literal["none", "csrt", "kcf"] = Field(
            "none", description="Box tracker that checks the mask and recovers it if it is lost."
        )
        witness_weight: float = weight(_CUES.box, "Weight of the distance outside the box tracker's box.")

    def __init__(self, options: FlowTracker.Options) -> None:
        self._options = options
        self._segmentation: ColourSegmentation | None = None
        self._box_tracker: OpenCvBoxes | None = None
        self._tracked_box: Box | None = None

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from its validated options."""
        if not isinstance(options, FlowTracker.Options):
            raise PluginError("The tracker flow was given the options of another tracker.")
        needed = _BOX_TRACKERS.get(options.witness)
        if needed and (why := why_no_contrib(needed)):
            raise PluginError(f"The box tracker {options.witness} of the tracker flow cannot be used: {why}.")
        return cls(options)

    @classmethod
    def why_unavailable(cls) -> str:
        """What the OpenCV in use lacks for this tracker; empty if it lacks nothing."""
        return why_no_contrib(SMOOTHER)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a box or a mask; the prompt's mask is the first estimate, else the box's segmentation."""
        check_box_in_frame(prompt.box, frame)
        options = self._options
        weights = {
            one.name: getattr(options, one.name)
            for one in fields(Cues)
            if one.name in type(options).model_fields
        }
        cues = Cues(**weights, box=options.witness_weight)
        self._segmentation = ColourSegmentation(
            frame.image, prompt.box, prompt.mask, size=options.segmentation_size, cues=cues
        )
        self._box_tracker = _start_box_tracker(options.witness, frame.image, prompt.box)
        self._tracked_box = prompt.box
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Estimate the mask in the next frame."""
        if self._segmentation is None:
            raise PluginError("The tracker flow must be started with init before it tracks a frame.")
        self._tracked_box = self._box_tracker.update(frame.image) if self._box_tracker else None
        return self._segmentation.step(frame.image, self._tracked_box)

    def skip(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in the next frame; the box tracker does not look at it."""
        if self._segmentation is not None:
            self._segmentation.skip(frame.image, mask)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Continue from ``mask`` ``(H, W)`` in ``frame``; re-initialize the box tracker too if it has drifted."""
        box = box_of(mask)
        if box is None or self._segmentation is None:
            return
        self._segmentation.correct(frame.image, mask)
        if self._tracked_box is None or box_iou(self._tracked_box, box) < STRAYED:
            self._box_tracker, self._tracked_box = (
                _start_box_tracker(self._options.witness, frame.image, box),
                box,
            )


def _start_box_tracker(name: str, image: Image, box: Box) -> OpenCvBoxes | None:
    if name == "csrt":
        return BoxTracker(CsrtTracker.Options(), image, box)
    return OpenCvBoxes(cv2.TrackerKCF.create(), image, box) if name == "kcf" else None
