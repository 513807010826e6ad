"""A mask tracker on OpenCV's NanoTrack: an example of a tracking3d plug-in that runs networks through OpenCV.

NanoTrack (https://github.com/HonglinChu/SiamTrackers) finds the box, tracking3d's colour segmentation the object
in it: masks at about the price of the built-in ``csrt``, with a better box.
"""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import InputError, PluginError
from tracking3d.features.networks.store import find_network
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.onnx.boxes import NetworkBoxes, nano_boxes
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import ColourSegmentation


class NanoTracker:
    """Mask tracker ``nanotrack``. It fulfils the protocol ``tracking3d.trackers.protocol.MaskTracker``."""

    class Options(Options):
        """What can be set in YAML under ``tracker:`` or with ``--set tracker.<name>=...``."""

        backbone: str = Field("nanotrack-backbone", description="ONNX file or known name of the backbone.")
        head: str = Field("nanotrack-head", description="The same of the head.")
        segmentation_size: int = Field(
            224, ge=64, le=1024, description="Side of the segmentation's crop in pixels."
        )

    def __init__(self, boxes: NetworkBoxes, segmentation_size: int) -> None:
        self._boxes, self._size = boxes, segmentation_size
        self._segmentation: ColourSegmentation | None = None

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from options that tracking3d has checked against ``Options``."""
        chosen = cls.Options.model_validate(options.model_dump())
        files = find_network(chosen.backbone), find_network(chosen.head)
        return cls(nano_boxes(*files), chosen.segmentation_size)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame: the given mask, or the object segmented in the box."""
        if clip_box(prompt.box, frame.image.shape) is None:
            raise InputError(f"The box lies outside {frame.name or 'the first frame'}; give one inside it.")
        self._segmentation = ColourSegmentation(frame.image, prompt.box, prompt.mask, size=self._size)
        self._boxes.start(frame.image, prompt.box)
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Answer for the next frame."""
        if self._segmentation is None:
            raise PluginError("The tracker nanotrack was asked for a frame before it was started with init.")
        return self._segmentation.step(frame.image, self._boxes.update(frame.image))

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from a better mask."""
        if (box := box_of(mask)) is not None and self._segmentation is not None:
            self._segmentation.correct(frame.image, mask)
            self._boxes.start(frame.image, box)
