"""What moves along with the object beside its mask: the frame at hand against those before it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.answer_mask import finer, seen_through
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import Belief, ObjectMap
from tracking3d.estimation.online.mapping import viewing_angle
from tracking3d.estimation.online.recruits import still
from tracking3d.evidence.moving_along import Glimpse, moves_along
from tracking3d.geometry.pose import Pose

_MOST = 10  # earlier frames
_SAME_SIDE, _AWAY = 12.0, 30.0  # degrees between viewing directions
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
    moving = moves_along(here, state.past, window, state.camera, vertices, known.shape.faces.cpu().numpy())
    if moving is not None and seen_again(known, pose):
        moving = np.where(seen_through(taken, window), moving, np.minimum(moving, 0))
    return moving


def seen_again(known: ObjectMap, pose: Pose) -> bool:
    """Whether a keyframe shows this side, and the object has turned away since: nothing of it is new.

    What moves along beside it is a hand, then.
    """
    for position, view in enumerate(known.keyframes):
        if viewing_angle(view.pose, pose) < _SAME_SIDE and any(
            viewing_angle(view.pose, later.pose) > _AWAY for later in known.keyframes[position + 1 :]
        ):
            return True
    return False


def with_past(state: Belief, answer: FrameEstimate, found: Attempt, image: NDArray[np.uint8]) -> Belief:
    """The belief that remembers a frame which is believed; after a loss it begins anew."""
    if found.lost:
        return replace(state, past=())
    if found.support.witnesses < _WITNESSES:
        return state
    seen = Glimpse.of(image, answer.mask, answer.T_cam_obj)
    return replace(state, past=(*state.past, seen)[-_MOST:])
