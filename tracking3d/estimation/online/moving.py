"""What moves along with the object beside its mask: the frame at hand against those before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.answer_mask import finer
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import Belief
from tracking3d.estimation.online.recruits import still
from tracking3d.evidence.moving_along import Glimpse, moves_along

_MOST = 10  # earlier frames
_WITNESSES = 20  # points that agree, with which a pose can tell a motion


def moving_beside(state: Belief, found: Attempt, image: NDArray[np.uint8]) -> NDArray[np.float32] | None:
    """``(S, S)`` what moves along in the window of `finer`; None where that cannot be told.

    Args:
        state: Before the frame.
        found: In the frame.
        image: ``(H, W)`` grey.
    """
    mask = found.view.mask
    if mask is None or found.lost or found.support.witnesses < _WITNESSES or not state.past:
        return None
    known, pose = state.known, found.fit.pose
    if still(known.beside):
        return None
    taken = mask | known.silhouette(pose, state.camera)
    if taken[[0, -1]].any() or taken[:, [0, -1]].any():  # what is cut off by the frame's border is leaving
        return None
    here = Glimpse.of(image, taken, pose.matrix().numpy())
    vertices = known.vertices.double().cpu().numpy()
    window, _ = finer(found.view.observation)
    return moves_along(here, state.past, window, state.camera, vertices, known.shape.faces.cpu().numpy())


def with_past(state: Belief, answer: FrameEstimate, found: Attempt, image: NDArray[np.uint8]) -> Belief:
    """The belief that remembers a frame which is believed; after a loss it begins anew."""
    if found.lost:
        return replace(state, past=())
    if found.support.witnesses < _WITNESSES:
        return state
    seen = Glimpse.of(image, answer.mask, answer.T_cam_obj)
    return replace(state, past=(*state.past, seen)[-_MOST:])
