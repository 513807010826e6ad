"""Which answers are handed back to the mask tracker, so that it goes on from them."""

from __future__ import annotations

import numpy as np

from tracking3d.estimation.estimate import FrameEstimate, Status

SURE = 0.6
"""Confidence from which an answer's mask is handed back to the mask tracker. An answer that is as likely wrong as right
would teach it as many errors as it mends; the tracker ``onnx`` trusts its own masks from the same score on."""

WORTH_CORRECTING = (0.5, 0.9)
"""IoU of answer and initial mask between which the latter is corrected. Above, they differ by little more than the
width of an outline; below, one of them is of something else, and nobody knows which."""


SIGHTED = "sighted"
"""What `FrameEstimate.hypothesis` says where the object was found by its points alone, anywhere in the frame: the mask
tracker was elsewhere or had nothing, whatever its mask."""


def corrects(estimate: FrameEstimate) -> bool:
    """Whether an answer is sure enough, and unlike the initial mask enough, to be handed back to the mask tracker."""
    if estimate.status is not Status.TRACKED:
        return False
    if estimate.hypothesis == SIGHTED:
        return True
    if estimate.initial_mask is None:
        return False
    both = np.count_nonzero(estimate.mask & estimate.initial_mask)
    either = np.count_nonzero(estimate.mask | estimate.initial_mask)
    least, most = WORTH_CORRECTING
    return bool(estimate.confidence >= SURE and least * either <= both <= most * either and both)
