"""The belief where the user steers: frames that turn back, and a mask that is known to be right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.belief import Belief
from tracking3d.estimation.online.mapping import pose_of
from tracking3d.estimation.online.points import FollowedPoints, follow, grey
from tracking3d.frames import Frame

_ELSEWHERE = 0.3
"""IoU of the last pose's silhouette with a mask that is right, below which that pose is none to go on from."""


def turned_back(state: Belief, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]) -> Belief:
    """The belief that goes on from a frame seen long ago, with all that was learnt since.

    Args:
        state: After the last frame.
        frame: The frame to go on from.
        number: The index that the last frame had: the next one's comes after it.
        T_cam_obj: ``(4, 4)`` the answer for the frame, taken where it is no keyframe.
    """
    views = [*state.known.keyframes, *(view for view, _ in state.waiting or ())]
    own = next((view for view in views if view.index == frame.index), None)
    pose = pose_of(T_cam_obj[:3, :3], T_cam_obj[:3, 3], state.known.vertices) if own is None else own.pose
    return replace(
        state,
        last=(pose, number),
        anew=None,
        before=None,
        grey=grey(frame.image),
        followed=FollowedPoints.none() if own is None else own.points,
        lost_for=0,
        doubted_for=0,
        trail=((pose, number),) if state.waiting is None else (),
        past=(),
    )


def trusting(state: Belief, frame: Frame, mask: NDArray[np.bool_]) -> Belief:
    """The belief before a frame whose mask ``(H, W)`` is right: points that are followed out of it are no witnesses.

    Without witnesses against it the mask counts in full. Where the last pose is elsewhere the object was lost, though
    nobody noticed: all sides of it are looked at, where the mask is.
    """
    if state.waiting is None:
        rendered = state.known.silhouette(state.last[0], state.camera)
        if np.count_nonzero(rendered & mask) < _ELSEWHERE * np.count_nonzero(rendered | mask):
            state = replace(state, lost_for=max(state.lost_for, 1))
    if not len(state.followed):
        return state
    here = follow(state.grey, grey(frame.image), state.followed)
    x, y = np.rint(here.pixel).astype(int).T
    inside = mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)]
    stay = np.isin(state.followed.landmark, here.landmark[inside])
    return replace(state, followed=state.followed.only(stay))
