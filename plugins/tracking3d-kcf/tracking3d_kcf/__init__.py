"""A mask tracker on OpenCV's KCF (Henriques et al. 2015): an example of a tracking3d plug-in.

KCF finds the box, tracking3d's colour segmentation the object in it.
"""

from __future__ import annotations

from typing import Self

import cv2
from pydantic import BaseModel, Field

from tracking3d.errors import InputError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import SMOOTHER, ColourSegmentation


class KcfTracker:
    """Mask tracker ``kcf``. It fulfils the protocol ``tracking3d.trackers.protocol.MaskTracker``."""

    class Options(Options):
        """What can be set in YAML under ``tracker:`` or with ``--set tracker.<name>=...``."""

        threshold: float = Field(0.5, ge=0, le=1, description="Peak below which KCF says the object is lost.")

    def __init__(self, options: KcfTracker.Options) -> None:
        params = cv2.TrackerKCF.Params()
        params.detect_thresh = options.threshold
        self._filter = cv2.TrackerKCF.create(params)

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from options that tracking3d has checked against ``Options``."""
        return cls(cls.Options.model_validate(options.model_dump()))

    @classmethod
    def why_unavailable(cls) -> str:
        """What the OpenCV in use lacks for this tracker; empty where it lacks nothing."""
        return why_no_contrib("TrackerKCF", SMOOTHER)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start on the first frame: the given mask, or the object segmented in the box."""
        height, width = frame.size
        x, y, w, h = (round(value) for value in prompt.box)
        if min(x, y) < 0 or x + w > width or y + h > height or min(w, h) < 4:
            raise InputError(
                f"kcf needs a box of at least 4x4 pixels inside {frame.name}; give one, or use csrt."
            )
        self._segmentation = ColourSegmentation(frame.image, prompt.box, prompt.mask)
        self._filter.init(cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR), (x, y, w, h))
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Answer for the next frame."""
        found, box = self._filter.update(cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        return self._segmentation.step(frame.image, tuple(box) if found else None)
