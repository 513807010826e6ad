"""From OSTrack's boxes to masks: by AlphaRefine, or by tracking3d's colour segmentation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, PluginError
from tracking3d.frames import Frame, MaskEstimate, Prompt
from tracking3d.trackers.crops import box_of, clip_box
from tracking3d.trackers.segmentation import ColourSegmentation
from tracking3d_ostrack.network import OsTrackBoxes
from tracking3d_ostrack.refinement import AlphaRefine


class NetworkTracker:
    """Tracks by networks. A mask tracker, see `tracking3d.trackers.protocol.MaskTracker`.

    Args:
        boxes: OSTrack.
        refinement: AlphaRefine, or None for the colour segmentation.
    """

    def __init__(self, boxes: OsTrackBoxes, refinement: AlphaRefine | None = None) -> None:
        self._boxes = boxes
        self._refinement = refinement
        self._segmentation: ColourSegmentation | None = None
        self._started = False

    def init(self, frame: Frame, prompt: Prompt) -> MaskEstimate:
        """Start from a box or a mask; the mask is the first answer, else the network's in the box.

        Raises:
            InputError: If the box lies outside the frame.
        """
        box = clip_box(prompt.box, frame.image.shape)
        if box is None:
            raise InputError(
                f"The box {prompt.box} lies outside {frame.name or 'the first frame'}; give a box inside it."
            )
        self._boxes.start(frame.image, box)
        self._started = True
        if self._refinement is None:
            self._segmentation = ColourSegmentation(frame.image, box, prompt.mask)
            return self._segmentation.estimate
        self._refinement.start(frame.image, box)
        if prompt.mask is not None:
            return MaskEstimate(prompt.mask.astype(np.float32))
        answer = _estimate(self._refinement.mask(frame.image, box), 1.0)
        if answer.mask is not None:
            return answer
        return ColourSegmentation(frame.image, box).estimate

    def step(self, frame: Frame) -> MaskEstimate:
        """Answer for the next frame."""
        if not self._started:
            raise PluginError("The tracker ostrack was asked for a frame before it was started with init.")
        box, score = self._boxes.update(frame.image)
        if self._refinement is not None:
            return _estimate(self._refinement.mask(frame.image, box), score)
        assert self._segmentation is not None
        answer = self._segmentation.step(frame.image, box)
        return MaskEstimate(answer.mask, answer.score * score, answer.reason)

    def correct(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Go on from ``mask`` ``(H, W)`` in ``frame``; the template stays that of the first frame."""
        box = box_of(mask)
        if box is None or not self._started:
            return
        self._boxes.box = box
        if self._segmentation is not None:
            self._segmentation.correct(frame.image, mask)


def _estimate(probability: NDArray[np.float32], score: float) -> MaskEstimate:
    inside = probability > 0.5
    if not inside.any():
        return MaskEstimate(None, 0.0, "AlphaRefine finds no object in OSTrack's box")
    return MaskEstimate(probability, score * float(probability[inside].mean()))
