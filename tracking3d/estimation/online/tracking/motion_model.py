"""The motion model: predicts an object's pose in the next frame from its earlier motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.mapping.local_mapping import project_points
from tracking3d.estimation.online.state.confidence import PoseCandidate
from tracking3d.estimation.online.state.solver_state import SolverPhase, SolverState
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, extrapolate, rotation_angle

_BRIEF, _NEAR = 5, 30.0
"""Lost frames, and degrees, within which the motion model supports a side that was never seen, as a card's edge."""


def pose_predictions(state: SolverState, index: int, mask: NDArray[np.bool_] | None) -> dict[str, Pose]:
    """Predicted poses for frame ``index`` by name, the likeliest first.

    Args:
        state: The state before the frame.
        index: The frame's index.
        mask: ``(H, W)`` its initial mask, or None; it places an object that was lost.
    """
    last, last_index = state.last_pose
    if state.phase is SolverPhase.LOST and state.trajectory:
        starts = {
            "motion_model": extrapolate_motion(state.trajectory, index),
            "last": state.trajectory[-1][0],
        }
        if mask is not None:
            starts |= {
                f"{name} in the mask": align_to_mask(pose, state.camera, mask)
                for name, pose in starts.items()
            }
            if state.last_candidate is not None:
                starts["last_candidate"] = align_to_mask(state.last_candidate, state.camera, mask)
        return starts
    if state.previous_pose is None:
        return {"last": last}
    before, before_index = state.previous_pose
    steps = (index - last_index) / max(last_index - before_index, 1)
    return {"velocity": extrapolate(before, last, min(steps, 3.0)), "last": last}


def predict_points(state: SolverState, pose: Pose) -> NDArray[np.float32] | None:
    """``(N, 2)`` predicted pixels of the tracked points at a pose; None if there are none."""
    if not len(state.tracked_points):
        return None
    position = state.object_map.landmarks[state.tracked_points.landmark]
    there, here = (project_points(position, one, state.camera) for one in (pose, state.last_pose[0]))
    return np.asarray(state.tracked_points.pixel + np.nan_to_num(there - here), dtype=np.float32)


def is_consistent_with_motion(state: SolverState, pose: Pose, index: int) -> bool:
    """Whether a pose agrees with the motion before a loss: only for a short loss, and near the extrapolated pose."""
    if not state.trajectory or index - state.trajectory[-1][1] > _BRIEF + 1:
        return False
    away = float(rotation_angle(extrapolate_motion(state.trajectory, index).quaternion, pose.quaternion))
    return math.degrees(away) < _NEAR


def advance(state: SolverState, found: PoseCandidate, pose: Pose, grey: NDArray[np.uint8]) -> SolverState:
    """The state one frame later, with the counts of lost and doubtful frames updated.

    Args:
        state: The state before the frame.
        found: The frame's pose candidate.
        pose: The pose that is estimated for it.
        grey: ``(H, W)`` the frame.
    """
    searched_for = state.lost_frames + 1 if found.view.mask is not None else max(state.lost_frames, 1)
    return replace(
        state.advanced(pose, found.view.index, grey, found.points),
        lost_frames=found.lost * searched_for,
        doubtful_frames=found.doubtful * (state.doubtful_frames + 1),
        last_candidate=found.fit.pose if found.lost and found.view.mask is not None else None,
    )


def extend_trajectory(state: SolverState, pose: Pose, index: int) -> SolverState:
    """The state with one more tracked frame for the motion model."""
    return replace(state, trajectory=(*state.trajectory, (pose, index))[-TRAJECTORY_LENGTH:])


TRAJECTORY_LENGTH = 5
"""Tracked frames that are extrapolated from."""
_MAX_EXTRAPOLATION = 12  # frames


def extrapolate_motion(trail: tuple[tuple[Pose, int], ...], index: int) -> Pose:
    """The pose of an object that is not seen: its motion is extrapolated for at most `_MAX_EXTRAPOLATION` frames.

    Args:
        trail: Reliable poses and their frame indices, in order of time; at least one.
        index: The frame's index.
    """
    (first, begin), (last, end) = trail[0], trail[-1]
    if begin == end:
        return last
    return extrapolate(first, last, min(index - end, _MAX_EXTRAPOLATION) / (end - begin))


def align_to_mask(pose: Pose, camera: Camera, mask: NDArray[np.bool_]) -> Pose:
    """A pose shifted parallel to the image plane, so that the object's centre projects into a mask ``(H, W)``."""
    x1, y1 = np.argwhere(mask)[:, ::-1].mean(0)
    x, y, z = pose.translation.tolist()
    shift = [(x1 - camera.cx) / camera.fx * z - x, (y1 - camera.cy) / camera.fy * z - y, 0.0]
    return Pose(pose.translation + pose.translation.new_tensor(shift), pose.quaternion)
