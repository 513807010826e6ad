"""Decides which estimated masks are fed back to the mask tracker."""

from __future__ import annotations

import numpy as np

from tracking3d.estimation.estimate import FrameEstimate, Status

SURE = 0.9
"""Confidence from which an answer's mask is handed back to the mask tracker. An answer that is as likely wrong as right
would teach it as many errors as it mends, and what it was taught wrongly comes back as evidence."""

WORTH_CORRECTING = (0.5, 0.9)
"""IoU of answer and initial mask between which the latter is corrected. Above, they differ by little more than the
width of an outline; below, one of them is of something else, and nobody knows which."""


RELOCALIZED = "relocalized"
"""What `FrameEstimate.hypothesis` says where the object was found by its points alone, anywhere in the frame; where the
mask tracker was elsewhere or had nothing, it is set on what was found, however sure that is."""


ELSEWHERE = 0.2
"""IoU of the object's silhouette, or mask, with the initial mask up to which that is of something else."""


MOTION_RATIO = "motion_ratio"
"""In `FrameEstimate.diagnostics`: the share of the mask by which it differs from the initial mask because of parts that
move as the object does."""

MOVES = 0.02
"""Such a share from which on the answer is handed back, however sure it is: a side that turns into view lies beside the
mask for a few frames only, and a pose that is judged by a mask without it cannot be sure."""


def corrects(estimate: FrameEstimate) -> bool:
    """Whether an estimate is confident enough, and differs enough from the initial mask, to be fed back."""
    moving = estimate.diagnostics.get(MOTION_RATIO, 0.0) >= MOVES
    if estimate.status is not Status.TRACKED and not moving:
        return False
    if estimate.initial_mask is None:
        return estimate.hypothesis == RELOCALIZED
    visible = estimate.visible_mask
    both = int(np.count_nonzero(visible & estimate.initial_mask))
    either = int(np.count_nonzero(visible | estimate.initial_mask))
    if estimate.hypothesis == RELOCALIZED and both <= ELSEWHERE * either:
        return True
    least, most = WORTH_CORRECTING
    if not both or both < least * either:
        return False
    return moving or (estimate.confidence >= SURE and both <= most * either)
