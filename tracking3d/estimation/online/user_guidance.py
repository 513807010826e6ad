"""The state under user guidance: frames in reverse order, and a mask that is known to be correct."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints, follow, grey
from tracking3d.estimation.online.state.solver_state import SolverPhase, SolverState
from tracking3d.frames import Frame
from tracking3d.geometry.pose import pose_from_arrays

_MIN_MASK_IOU = 0.3
"""IoU of the last pose's silhouette with a correct mask, below which the last pose is discarded."""


def restart_backwards(
    state: SolverState, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]
) -> SolverState:
    """The state that continues from an earlier frame, with everything learnt since.

    Args:
        state: The state after the last frame.
        frame: The frame to continue from.
        number: The index of the last frame; the next one's follows it.
        T_cam_obj: ``(4, 4)`` the frame's estimate, used if the frame is no keyframe.
    """
    views = [*state.object_map.keyframes, *(view for view, _ in state.pending or ())]
    own = next((view for view in views if view.index == frame.index), None)
    pose = (
        pose_from_arrays(T_cam_obj[:3, :3], T_cam_obj[:3, 3], state.object_map.vertices)
        if own is None
        else own.pose
    )
    return replace(
        state,
        last_pose=(pose, number),
        reinitialization=None,
        previous_pose=None,
        grey=grey(frame.image),
        tracked_points=FollowedPoints.none() if own is None else own.points,
        lost_frames=0,
        doubtful_frames=0,
        trajectory=((pose, number),) if state.pending is None else (),
        motion_references=(),
    )


def trust_mask(state: SolverState, frame: Frame, mask: NDArray[np.bool_]) -> SolverState:
    """The state before a frame whose mask ``(H, W)`` is correct: tracked points that leave the mask are dropped.

    Without inliers against it the mask has full weight. If the last pose is elsewhere, the object was lost unnoticed:
    all of its sides are then tried at the mask.
    """
    if state.phase is not SolverPhase.INITIALIZING:
        rendered = state.object_map.silhouette(state.last_pose[0], state.camera)
        if np.count_nonzero(rendered & mask) < _MIN_MASK_IOU * np.count_nonzero(rendered | mask):
            state = replace(state, lost_frames=max(state.lost_frames, 1))
    if not len(state.tracked_points):
        return state
    here = follow(state.grey, grey(frame.image), state.tracked_points)
    x, y = np.rint(here.pixel).astype(int).T
    inside = mask[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)]
    stay = np.isin(state.tracked_points.landmark, here.landmark[inside])
    return replace(state, tracked_points=state.tracked_points.only(stay))
