"""The belief where the user steers: frames that turn back, and a mask that is known to be right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints, follow, grey
from tracking3d.estimation.online.state.solver_state import SolverPhase, SolverState
from tracking3d.frames import Frame
from tracking3d.geometry.pose import pose_from_arrays

_MIN_MASK_IOU = 0.3
"""IoU of the last pose's silhouette with a mask that is right, below which that pose is none to go on from."""


def restart_backwards(
    state: SolverState, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]
) -> SolverState:
    """The belief that goes on from a frame seen long ago, with all that was learnt since.

    Args:
        state: After the last frame.
        frame: The frame to go on from.
        number: The index that the last frame had: the next one's comes after it.
        T_cam_obj: ``(4, 4)`` the answer for the frame, taken where it is no keyframe.
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
    """The belief before a frame whose mask ``(H, W)`` is right: points that are followed out of it are no witnesses.

    Without witnesses against it the mask counts in full. Where the last pose is elsewhere the object was lost, though
    nobody noticed: all sides of it are looked at, where the mask is.
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
