"""Boxes from another program: the object is segmented in them by its colours."""

from __future__ import annotations

import numpy as np

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.crops import clip_box
from tracking3d.trackers.cues import Cues
from tracking3d.trackers.region_masks import RegionMasks
from tracking3d.trackers.segmentation import ColourSegmentation

_CUES = Cues(outline=0.0, background=0.0, novelty=0.0)  # the box does their work, as in the tracker csrt


class PrecomputedBoxes:
    """What the tracker ``precomputed`` is if its file holds boxes: the segmentation of ``csrt``, the box given.

    Args:
        regions: The boxes; line n is frame n.
    """

    def __init__(self, regions: RegionMasks) -> None:
        self._regions = regions
        self._segmentation: ColourSegmentation | None = None

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """The mask in the first frame's box; the prompt's mask if there is one.

        Raises:
            InputError: If that box lies outside the frame.
        """
        box = self._regions.box(frame.index) or prompt.box
        if clip_box(box, frame.image.shape) is None:
            raise InputError(
                f"The box in {self._regions.label(frame.index)} lies outside {frame.label}; boxes are "
                "x, y, width and height in its pixels."
            )
        self._segmentation = ColourSegmentation(frame.image, box, prompt.mask, cues=_CUES)
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """The mask in the frame's box; without a box, what the segmentation finds by itself, not to be relied on."""
        if self._segmentation is None:
            raise PluginError("The tracker precomputed must be started with init before it tracks a frame.")
        box = self._regions.box(frame.index)
        estimate = self._segmentation.step(frame.image, box)
        if box is None and estimate.mask is not None:
            return MaskEstimate(
                np.asarray(estimate.mask, np.float32), estimate.score / 2, "there is no box for this frame"
            )
        return estimate
