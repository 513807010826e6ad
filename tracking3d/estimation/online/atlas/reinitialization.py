"""Whether a lost object can be initialized a second time, with a map of its own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.state.confidence import BELIEVED
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.frames import Frame
from tracking3d.segmentation import as_lab

_SAME_MASK = 0.3  # IoU of the masks of two frames, below which they are of two things
_OTHER_COLOURS = -0.5  # mean log ratio of colours from which a mask is of something else


def masks_overlap(before: NDArray[np.bool_] | None, mask: NDArray[np.bool_]) -> bool:
    """Whether two frames' masks ``(H, W)`` overlap, as those of one thing do."""
    if before is None:
        return False
    either = int(np.count_nonzero(before | mask))
    return int(np.count_nonzero(before & mask)) > _SAME_MASK * either


def is_fully_visible(mask: NDArray[np.bool_]) -> bool:
    """Whether a mask ``(H, W)`` stays off the frame's border: an object that comes in shows little of itself."""
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool(mask.any() and not border.any())


def colours_match(state: SolverState, frame: Frame, mask: NDArray[np.bool_]) -> bool:
    """Whether what is in a mask ``(H, W)`` has no colours that speak against the object."""
    if state.colours is None:
        return True
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    crop = slice(y, y + height), slice(x, x + width)
    ratio = state.colours.log_ratio(as_lab(np.ascontiguousarray(frame.image[crop])))
    return float(ratio[mask[crop]].mean()) > _OTHER_COLOURS


def is_reliable(begun: SolverState, estimate: FrameEstimate) -> bool:
    """Whether a second start is one that can be gone on from."""
    return not begun.object_map.pointless and estimate.confidence >= BELIEVED
