"""Whether a lost object can be initialized a second time, with a map of its own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.features.texture_strength import PLAIN, texture_strength
from tracking3d.estimation.online.state.solver_state import SolverPhase, SolverState
from tracking3d.frames import TRACKED_CONFIDENCE, Frame
from tracking3d.segmentation import as_lab

_LASTING_DOUBT = 20  # doubtful frames in a row from which a map without points is doubted itself
_MIN_MASK_IOU = 0.3  # IoU of two frames' masks, below which they show different objects
_MIN_COLOUR_RATIO = -0.5  # mean log ratio of the colours, below which a mask shows another object


def needs_second_map(state: SolverState, image: NDArray[np.uint8], mask: NDArray[np.bool_]) -> bool:
    """Whether a second map is begun, or continued, after a frame.

    It is if the object is lost. A map without points is given up if its poses have been doubtful for long, too, but
    only if there is texture now: another map without points would be no better.

    Args:
        state: After the frame.
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` of the object.
    """
    if state.object_map.fixed_keyframes:
        return False
    if not state.object_map.pointless:
        return state.phase is SolverPhase.LOST
    doubted = state.phase is SolverPhase.LOST or state.doubtful_frames >= _LASTING_DOUBT
    return doubted and texture_strength(image, mask) >= PLAIN


def masks_overlap(before: NDArray[np.bool_] | None, mask: NDArray[np.bool_]) -> bool:
    """Whether the masks ``(H, W)`` of two frames overlap enough to show the same object."""
    if before is None:
        return False
    either = int(np.count_nonzero(before | mask))
    return int(np.count_nonzero(before & mask)) > _MIN_MASK_IOU * either


def is_fully_visible(mask: NDArray[np.bool_]) -> bool:
    """Whether a mask ``(H, W)`` does not touch the frame's border: an object that enters shows little of itself."""
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return bool(mask.any() and not border.any())


def colours_match(state: SolverState, frame: Frame, mask: NDArray[np.bool_]) -> bool:
    """Whether the colours inside a mask ``(H, W)`` do not contradict the object's colour model."""
    if state.colours is None:
        return True
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    crop = slice(y, y + height), slice(x, x + width)
    ratio = state.colours.log_ratio(as_lab(np.ascontiguousarray(frame.image[crop])))
    return float(ratio[mask[crop]].mean()) > _MIN_COLOUR_RATIO


def is_reliable(begun: SolverState, estimate: FrameEstimate) -> bool:
    """Whether a second initialization is reliable enough to continue with."""
    return not begun.object_map.pointless and estimate.confidence >= TRACKED_CONFIDENCE
