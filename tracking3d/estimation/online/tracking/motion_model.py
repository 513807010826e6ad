"""Where an object should be in the next frame, by how it has moved; and the belief as it moves on."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.mapping.local_mapping import project_points
from tracking3d.estimation.online.state.pose_candidate import PoseCandidate
from tracking3d.estimation.online.state.solver_state import SolverPhase, SolverState
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, extrapolate, rotation_angle

_BRIEF, _NEAR = 5, 30.0
"""Frames of a loss, and degrees, within which motion still tells a side that was never seen: a thin view of a card."""


def pose_predictions(state: SolverState, index: int, mask: NDArray[np.bool_] | None) -> dict[str, Pose]:
    """Poses to start from in frame ``index``, by name, the likeliest first.

    Args:
        state: Before the frame.
        index: Of the frame.
        mask: ``(H, W)`` its initial mask, or None: of an object that was lost it says where it is again.
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
    """``(N, 2)`` pixels where the points that are followed should be at a pose; None where there are none."""
    if not len(state.tracked_points):
        return None
    position = state.object_map.landmarks[state.tracked_points.landmark]
    there, here = (project_points(position, one, state.camera) for one in (pose, state.last_pose[0]))
    return np.asarray(state.tracked_points.pixel + np.nan_to_num(there - here), dtype=np.float32)


def is_consistent_with_motion(state: SolverState, pose: Pose, index: int) -> bool:
    """Whether the motion from before a loss leads to a pose: only a while, and only near where it goes on."""
    if not state.trajectory or index - state.trajectory[-1][1] > _BRIEF + 1:
        return False
    away = float(rotation_angle(extrapolate_motion(state.trajectory, index).quaternion, pose.quaternion))
    return math.degrees(away) < _NEAR


def advance(state: SolverState, found: PoseCandidate, pose: Pose, grey: NDArray[np.uint8]) -> SolverState:
    """The belief one frame later, with how long the object has been lost or hardly believed.

    Args:
        state: Before the frame.
        found: What was found in it.
        pose: That it is answered with.
        grey: ``(H, W)`` the frame.
    """
    searched_for = state.lost_frames + 1 if found.view.mask is not None else max(state.lost_frames, 1)
    return replace(
        state.advanced(pose, found.view.index, grey, found.points),
        lost_frames=found.lost * searched_for,
        doubtful_frames=found.doubtful * (state.doubtful_frames + 1),
        last_candidate=found.fit.pose if found.lost and found.view.mask is not None else None,
    )


_MAX_EXTRAPOLATION = 12  # frames


def extrapolate_motion(trail: tuple[tuple[Pose, int], ...], index: int) -> Pose:
    """Where an object is that is not seen: moving on as it did, for a while.

    Args:
        trail: Believed poses and their frame indices, in order of time; at least one.
        index: Of the frame.
    """
    (first, begin), (last, end) = trail[0], trail[-1]
    if begin == end:
        return last
    return extrapolate(first, last, min(index - end, _MAX_EXTRAPOLATION) / (end - begin))


def align_to_mask(pose: Pose, camera: Camera, mask: NDArray[np.bool_]) -> Pose:
    """A pose moved in front of the camera, at its depth, to where a mask ``(H, W)`` is."""
    x1, y1 = np.argwhere(mask)[:, ::-1].mean(0)
    x, y, z = pose.translation.tolist()
    shift = [(x1 - camera.cx) / camera.fx * z - x, (y1 - camera.cy) / camera.fy * z - y, 0.0]
    return Pose(pose.translation + pose.translation.new_tensor(shift), pose.quaternion)
