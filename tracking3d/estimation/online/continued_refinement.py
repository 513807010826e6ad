"""A final refinement that starts from an earlier one: most frames keep their refined poses, and so does the surface."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints, grey
from tracking3d.estimation.online.frame_tracker import FrameTracker
from tracking3d.estimation.online.mapping.refined_map import move_to_refined, project_landmarks
from tracking3d.estimation.online.state.solver_state import SolverPhase, SolverState
from tracking3d.estimation.online.tracking.motion_model import TRAJECTORY_LENGTH
from tracking3d.estimation.solver import RefinedStart
from tracking3d.frames import Frame
from tracking3d.geometry.pose import pose_from_arrays


@dataclass(frozen=True)
class ContinuedRefinement(FrameTracker):
    """What the solver `online` needs for `tracking3d.estimation.solver.ContinuingSolver`."""

    def continue_refinement(self, state: SolverState, start: RefinedStart) -> SolverState | None:
        """The state with an earlier refinement's surface and poses; None if it has several maps, or another one."""
        if state.phase is SolverPhase.INITIALIZING or state.inactive_maps or state.unaligned:
            return None
        object_map = move_to_refined(state.object_map, state.camera, start, self.online)
        if object_map is None:
            return None
        return replace(
            state,
            spans=(*state.spans, (state.active_since, state.last_pose[1])),
            camera=start.camera,
            object_map=object_map,
            surface=object_map.surface(),
            previous_pose=None,
            lost_frames=0,
            doubtful_frames=0,
            trajectory=(),
            tracked_points=FollowedPoints.none(),
        )

    def keyframe_poses(self, state: SolverState) -> dict[int, NDArray[np.float64]]:
        """Refined poses ``(4, 4)`` of the keyframes of a map with points, if the causal poses are all of that map."""
        object_map = state.object_map
        one_map = not (state.inactive_maps or state.extended or object_map.fixed_keyframes)
        if state.surface is None or object_map.pointless or not one_map:
            return {}
        return {view.index: view.pose.matrix().double().cpu().numpy() for view in object_map.keyframes}

    def keep_frame(self, state: SolverState, frame: Frame, T_cam_obj: NDArray[np.float64]) -> SolverState:
        """Take a frame whose refined pose stands, so that its landmarks are followed into the next one."""
        object_map = state.object_map
        pose = pose_from_arrays(T_cam_obj[:3, :3], T_cam_obj[:3, 3], object_map.vertices)
        before = state.last_pose if state.last_pose[1] == frame.index - 1 else None
        return replace(
            state,
            last_pose=(pose, frame.index),
            previous_pose=before,
            grey=grey(frame.image),
            tracked_points=project_landmarks(object_map, state.camera, pose),
            trajectory=(*state.trajectory, (pose, frame.index))[-TRAJECTORY_LENGTH:],
            lost_frames=0,
            doubtful_frames=0,
        )
