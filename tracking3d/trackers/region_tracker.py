"""A mask tracker that replays the regions written by another tracker, for plug-ins that read results."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tracking3d.errors import PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.segmentation import ColourSegmentation
from tracking3d.trackers.vot_regions import EncodedMask, Region, bounding_box, rasterise


class RegionTracker:
    """Replays the regions of a result; implements `tracking3d.trackers.protocol.MaskTracker`, but is built.

    An encoded mask is returned as it is. For a rectangle or a polygon, which only bound the object, the colour
    segmentation makes the mask; in a frame without a region it continues without one, with half the score.

    Args:
        regions: By the frame's index in the source, counted from 0.
        name: What reasons call the tracker that wrote them.
    """

    def __init__(self, regions: Mapping[int, Region], name: str) -> None:
        self._regions = regions
        self._name = name
        self._segmentation: ColourSegmentation | None = None

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame: its encoded mask, else the prompt's mask or the object in its box."""
        if (answer := self._encode(frame)) is not None:
            self._segmentation = ColourSegmentation(frame.image, prompt.box, answer.binary)
            return answer
        self._segmentation = ColourSegmentation(frame.image, prompt.box, prompt.mask)
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """The frame's region as a mask."""
        if self._segmentation is None:
            raise PluginError(
                f"The results of {self._name} must be started with init before a frame is read."
            )
        if (answer := self._encode(frame)) is not None:
            return answer
        region = self._regions.get(frame.index)
        box = None if region is None else bounding_box(region)
        estimate = self._segmentation.step(frame.image, box)
        if box is None and estimate.mask is not None:
            reason = f"{self._name} has no region for this frame"
            return MaskEstimate(estimate.mask, estimate.score / 2, reason)
        return estimate

    def _encode(self, frame: Frame) -> MaskEstimate | None:
        """The estimate if the frame's region is a mask."""
        region = self._regions.get(frame.index)
        if not isinstance(region, EncodedMask):
            return None
        mask = rasterise(region, frame.size)
        if not mask.any():
            return MaskEstimate(None, 0.0, f"{self._name} has an empty mask for this frame")
        return MaskEstimate(mask.astype(np.float32))
