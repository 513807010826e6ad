"""One frame against the map: its pose is estimated, and a frame that shows something new becomes a keyframe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.atlas.atlas import merge_maps
from tracking3d.estimation.online.continued_refinement import ContinuedRefinement
from tracking3d.estimation.online.features.klt import follow
from tracking3d.estimation.online.mapping.depth_reversal import fix_depth_reversal
from tracking3d.estimation.online.mapping.keyframe_insertion import insert_keyframe, needs_keyframe
from tracking3d.estimation.online.mapping.landmark_refinement import refine_by_landmarks
from tracking3d.estimation.online.masks.frame_estimates import (
    initial_estimate,
    learn_colours,
    make_estimate,
    measure_mask_agreement,
)
from tracking3d.estimation.online.masks.mask_fusion import motion_cue_in_window, remember_motion
from tracking3d.estimation.online.state.confidence import is_high_loss, is_misfit
from tracking3d.estimation.online.state.solver_state import SolverState, thin_out
from tracking3d.estimation.online.tracking.motion_model import (
    TRAJECTORY_LENGTH,
    advance,
    extrapolate_motion,
    pose_predictions,
    predict_points,
)
from tracking3d.estimation.online.tracking.pose_tracking import resect_pose
from tracking3d.frames import Frame
from tracking3d.runtime.stage_times import in_stage


@dataclass(frozen=True)
class FrameMapping(ContinuedRefinement):
    """Tracks an object with a map through one more frame, and extends the map."""

    def _track(
        self, state: SolverState, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> tuple[SolverState, FrameEstimate]:
        """Estimate the frame's pose, and insert the frame into the map if it shows something new."""
        starts = pose_predictions(state, frame.index, mask)
        likeliest = next(iter(starts.values()))
        followed = follow(state.grey, image, state.tracked_points, predict_points(state, likeliest))
        found = self._find(state, self._view(state, frame, mask, likeliest, followed), frame, image, starts)
        usual = not is_high_loss(found.fit, state.baseline, found.view.mask_weight)
        reliable = usual or found.evidence.is_decisive
        is_keyframe = not found.lost and reliable and needs_keyframe(state.object_map, found, self.online)
        pose = extrapolate_motion(state.trajectory, frame.index) if found.lost else found.fit.pose
        updated = advance(state, found, pose, image)
        if usual and not found.lost:
            updated = replace(updated, baseline=state.baseline.update(found.fit))
        if state.object_map.pointless:
            misfit = is_misfit(found.fit, state.baseline)
            updated = replace(updated, misfits=state.misfits + 1 if misfit else 0)
        if is_keyframe:
            view = replace(found.view, pose=pose, points=found.points)
            with in_stage("map"):
                object_map, followed = insert_keyframe(
                    state.object_map, state.camera, view, image, self.online
                )
                surface = object_map.surface()
                last = object_map.keyframes[-1].pose, frame.index
                updated = replace(
                    updated, object_map=object_map, surface=surface, last_pose=last, tracked_points=followed
                )
                updated = refine_by_landmarks(fix_depth_reversal(updated, self.online), self.online)
                updated = merge_maps(updated, self.online, updated.object_map.keyframes[-1:])
                if self.config.has_given_masks:
                    updated = measure_mask_agreement(updated)
            pose = updated.last_pose[0]
        if found.lost:
            updated = replace(updated, previous_pose=None)
        elif usual:
            updated = replace(
                updated, trajectory=(*updated.trajectory, (pose, frame.index))[-TRAJECTORY_LENGTH:]
            )
        found = replace(found, fit=replace(found.fit, pose=pose))
        plain, now = initial_estimate(frame, mask, pose, state.camera), updated
        estimate = make_estimate(now, plain, found, lambda: motion_cue_in_window(now, found, image))
        updated = remember_motion(learn_colours(updated, estimate, found), estimate, found, image)
        if state.revisable:
            updated = replace(updated, revisable=thin_out((*state.revisable, (found.view, plain))))
        if not (found.doubtful if state.object_map.pointless else found.lost):
            updated = replace(updated, reinitialization=None)
        if not (found.lost or is_keyframe):
            # Only what is reported: masks and map follow the pose that fits this surface and these outlines.
            pose = resect_pose(state.object_map, state.camera, found.view, pose)
            estimate = replace(estimate, T_cam_obj=pose.matrix().numpy())
        return updated, replace(estimate, keyframe=is_keyframe)
