"""The motion cue: what moves with the object next to its mask, by comparing the frame with earlier ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.mapping.candidate_landmarks import is_static_scene
from tracking3d.estimation.online.mapping.local_mapping import viewing_angle
from tracking3d.estimation.online.masks.mask_fusion import mask_in_window, upsampled_window
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.online.state.pose_candidate import PoseCandidate
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.geometry.pose import Pose
from tracking3d.segmentation.online_motion_cue import MotionReference, online_motion_log_odds

_MAX_REFERENCES = 10  # most earlier frames
_SAME_DIRECTION, _MIN_ROTATION = 12.0, 30.0  # degrees between viewing directions
_MIN_INLIERS = 20  # fewest inliers of a pose whose motion is used


def motion_cue_in_window(
    state: SolverState, found: PoseCandidate, image: NDArray[np.uint8]
) -> NDArray[np.float32] | None:
    """``(S, S)`` the motion cue in the window of `upsampled_window`; None if it cannot be determined.

    Args:
        state: The state before the frame.
        found: The frame's pose candidate.
        image: ``(H, W)`` grey.
    """
    mask = found.view.mask
    if mask is None or found.lost or found.evidence.inliers < _MIN_INLIERS or not state.motion_references:
        return None
    object_map, pose = state.object_map, found.fit.pose
    if is_static_scene(object_map.candidates_around):
        return None
    taken = mask | object_map.silhouette(pose, state.camera)
    if taken[[0, -1]].any() or taken[:, [0, -1]].any():  # an object cut off by the frame's border is leaving
        return None
    here = MotionReference.of(image, taken, pose.matrix().numpy())
    vertices = object_map.vertices.double().cpu().numpy()
    window, _ = upsampled_window(found.view.observation)
    moving = online_motion_log_odds(
        here, state.motion_references, window, state.camera, vertices, object_map.shape.faces.cpu().numpy()
    )
    if moving is not None and is_seen_again(object_map, pose):
        moving = np.where(mask_in_window(taken, window), moving, np.minimum(moving, 0))
    return moving


def is_seen_again(object_map: ObjectMap, pose: Pose) -> bool:
    """Whether a keyframe shows this side and the object has rotated away since, so that no part of it is new.

    What moves with the object next to its mask is then a hand.
    """
    for position, view in enumerate(object_map.keyframes):
        if viewing_angle(view.pose, pose) < _SAME_DIRECTION and any(
            viewing_angle(view.pose, later.pose) > _MIN_ROTATION
            for later in object_map.keyframes[position + 1 :]
        ):
            return True
    return False


def remember_motion(
    state: SolverState, estimate: FrameEstimate, found: PoseCandidate, image: NDArray[np.uint8]
) -> SolverState:
    """The state that remembers a reliable frame; after a loss the memory starts empty."""
    if found.lost:
        return replace(state, motion_references=())
    if found.evidence.inliers < _MIN_INLIERS:
        return state
    seen = MotionReference.of(image, estimate.mask, estimate.T_cam_obj)
    return replace(state, motion_references=(*state.motion_references, seen)[-_MAX_REFERENCES:])
