"""CSR-DCF with a mask: OpenCV's discriminative correlation filter (Lukezic et al. 2017) finds the box, a
temporally consistent colour segmentation finds the object in it.
"""

from __future__ import annotations

from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from tracking3d.errors import PluginError
from tracking3d.frames import Box, Frame, Image, MaskEstimate, Prompt
from tracking3d.trackers.box_trackers import BoxOffset, OpenCvBoxes
from tracking3d.trackers.crops import box_iou, box_of, check_box_in_frame
from tracking3d.trackers.cues import Cues
from tracking3d.trackers.opencv_build import why_no_contrib
from tracking3d.trackers.protocol import Options
from tracking3d.trackers.segmentation import SMOOTHER, ColourSegmentation

STRAYED = 0.7
"""IoU of a correction's box and the box tracker's below which the latter has left the object and is re-initialized.
Above, the filter learnt over many frames is worth more than a box that fits a little better."""

_CUES = Cues(outline=0.0, background=2.0, novelty=0.0)  # the box does the work of the others


class CsrtTracker:
    """Mask tracker ``csrt``: CSR-DCF proposes the box, the colour segmentation makes the mask.

    The box keeps the mask from spilling, checks it, and re-initializes it when it has lost the object. Estimates are
    deterministic: OpenCV's random generator is seeded before each use.

    Defaults were chosen by the mean IoU of the box over four real clips: colour features save a car in shadow
    (0.16 to 0.78), and CSR-DCF's own spatial reliability map costs half the time and gains nothing.
    """

    class Options(Options):
        """Options of ``csrt``; the names are those of ``cv2.TrackerCSRT.Params``."""

        segmentation_size: int = Field(
            224, ge=64, le=1024, description="Side of the segmentation's crop in pixels."
        )
        resolution: float = Field(1.0, gt=0, le=1, description="Scale of the box tracker's image.")
        use_rgb: bool = Field(True, description="Use raw colour as a feature of the filter.")
        use_hog: bool = Field(True, description="Use histograms of gradients as a feature of the filter.")
        use_color_names: bool = Field(True, description="Use colour names as a feature of the filter.")
        use_gray: bool = Field(True, description="Use grey values as a feature of the filter.")
        use_channel_weights: bool = Field(True, description="Weight features by how well they discriminate.")
        use_segmentation: bool = Field(False, description="Use CSR-DCF's own spatial reliability map.")
        template_size: float = Field(200.0, ge=16, le=1000, description="Side of the filter in pixels.")
        padding: float = Field(3.0, ge=1, le=10, description="Search region relative to the box.")
        filter_lr: float = Field(0.02, ge=0, le=1, description="Learning rate of the filter.")
        weights_lr: float = Field(0.02, ge=0, le=1, description="Learning rate of the channel weights.")
        psr_threshold: float = Field(
            0.035, ge=0, description="Filter response below which the object is lost."
        )
        number_of_scales: int = Field(33, ge=1, le=101, description="Number of scales tried in every frame.")
        scale_step: float = Field(1.02, gt=1, le=2, description="Factor from one scale to the next.")
        scale_lr: float = Field(0.025, ge=0, le=1, description="Learning rate of the scale filter.")

    def __init__(self, options: CsrtTracker.Options) -> None:
        self._options = options
        self._boxes: BoxTracker | None = None
        self._followed: Box | None = None
        self._offset = BoxOffset()
        self._segmentation: ColourSegmentation | None = None

    @classmethod
    def from_options(cls, options: BaseModel) -> Self:
        """Build the tracker from its validated options."""
        if not isinstance(options, CsrtTracker.Options):
            raise PluginError("The tracker csrt was given the options of another tracker.")
        return cls(options)

    @classmethod
    def why_unavailable(cls) -> str:
        """What the OpenCV in use lacks for this tracker; empty if it lacks nothing."""
        return why_no_contrib("TrackerCSRT", SMOOTHER)

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a box or a mask; the prompt's mask is the first estimate, else the box's segmentation."""
        check_box_in_frame(prompt.box, frame)
        self._segmentation = ColourSegmentation(
            frame.image, prompt.box, prompt.mask, size=self._options.segmentation_size, cues=_CUES
        )
        self._begin(frame.image, prompt.box)
        return self._segmentation.estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Estimate the mask in the next frame."""
        if self._segmentation is None or self._boxes is None:
            raise PluginError("The tracker csrt must be started with init before it tracks a frame.")
        self._followed = self._boxes.update(frame.image)
        box = self._tracked_box
        estimate = self._segmentation.step(frame.image, box)
        if box is None and estimate.mask is not None:
            return MaskEstimate(estimate.mask, estimate.score / 2, "CSR-DCF has lost the object")
        return estimate

    def announce(self, frame: Frame) -> None:
        """Search the box of the next frame concurrently; a correction that moves the box discards it."""
        if self._boxes is not None:
            self._boxes.announce(frame.image)

    def skip(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in the next frame; the box tracker does not look at it."""
        if self._segmentation is not None:
            self._segmentation.skip(frame.image, mask)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Re-anchor the segmentation on ``mask`` ``(H, W)`` in ``frame``, and the box tracker if it has strayed."""
        box = box_of(mask)
        if box is None or self._segmentation is None:
            return
        self._segmentation.correct(frame.image, mask)
        tracked = self._tracked_box
        if self._followed is None or tracked is None or box_iou(tracked, box) < STRAYED:
            self._begin(frame.image, box)
        else:
            self._offset = BoxOffset.between(self._followed, box)

    @property
    def _tracked_box(self) -> Box | None:
        """The box as the last correction had it; None if the box tracker has lost the object."""
        return None if self._followed is None else self._offset.apply(self._followed)

    def _begin(self, image: Image, box: Box) -> None:
        self._boxes, self._followed = BoxTracker(self._options, image, box), box
        self._offset = BoxOffset()


class BoxTracker(OpenCvBoxes):
    """OpenCV's CSR-DCF, deterministic, on RGB images at a chosen resolution.

    Args:
        options: The options of ``csrt``.
        image: ``(H, W, 3)`` RGB, the first frame.
        box: ``(x, y, w, h)`` in it, in pixels; the part inside the image is tracked.

    Raises:
        PluginError: If the OpenCV in use lacks CSR-DCF.
    """

    def __init__(self, options: CsrtTracker.Options, image: Image, box: Box) -> None:
        if why := why_no_contrib("TrackerCSRT"):
            raise PluginError(f"The box tracker CSR-DCF cannot be used: {why}.")
        params = cv2.TrackerCSRT.Params()
        for name in CsrtTracker.Options.model_fields.keys() & set(dir(params)):
            setattr(params, name, getattr(options, name))
        super().__init__(cv2.TrackerCSRT.create(params), image, box, options.resolution)
