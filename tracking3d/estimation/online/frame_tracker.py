"""Estimates the pose of one frame: cheap hypotheses first, then costly ones, then a search of the whole frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.keyframe_views import cut_around_object
from tracking3d.estimation.online.mapping.local_mapping import mask_weight
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.relocalization.pose_search import ROTATION_SEARCH, relocalize, should_retry
from tracking3d.estimation.online.relocalization.whole_frame import overlaps_mask, relocalize_in_frame
from tracking3d.estimation.online.state.confidence import assess_pose, needs_relocalization
from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.estimation.online.state.pose_candidate import PoseCandidate
from tracking3d.estimation.online.state.solver_state import SolverPhase, SolverState
from tracking3d.estimation.online.tracking.motion_model import is_consistent_with_motion
from tracking3d.estimation.online.tracking.pose_tracking import (
    find_inliers,
    fit_pose,
    pixel_scale,
    pose_evidence,
    pose_of_points,
)
from tracking3d.estimation.solver_base import SolverBase
from tracking3d.estimation.tracker_feedback import RELOCALIZED
from tracking3d.frames import Frame
from tracking3d.geometry.pose import Pose


@dataclass(frozen=True)
class FrameTracker(SolverBase):
    """Estimates the pose of an object with a map in one frame."""

    @property
    def online(self) -> OnlineConfig:
        """The options of the online solver."""
        assert isinstance(self.config.solver, OnlineConfig)
        return self.config.solver

    @property
    def weights(self) -> PoseWeights:
        """The weights of a pose's cost terms."""
        weights = self.online.weights
        return PoseWeights(weights.appearance, outline=weights.outline, points=weights.points)

    def _find(
        self,
        state: SolverState,
        view: Keyframe,
        frame: Frame,
        image: NDArray[np.uint8],
        starts: dict[str, Pose],
    ) -> PoseCandidate:
        """The pose near the predicted ones; relocalized if the losses are unusual, in the whole frame if doubtful."""
        assert state.surface is not None
        object_map, camera = state.object_map, state.camera
        on_object = view.points.only(~object_map.candidate[view.points.landmark])
        points = pose_of_points(object_map, camera, on_object, pixel_scale(view))
        if points is not None:
            starts = {**starts, "points": points[0]}
        won, fit = self._fit(state, view, starts, view.points)
        kept = find_inliers(object_map, camera, fit.pose, view.points, view)
        support = pose_evidence(object_map, camera, fit.pose, kept, view)
        if state.phase is SolverPhase.LOST or needs_relocalization(fit, state.baseline, support):
            won, fit, kept = relocalize(
                object_map,
                state.surface,
                camera,
                view,
                image,
                (won, fit, kept),
                self.weights,
                state.lost_frames,
            )
            support = pose_evidence(object_map, camera, fit.pose, kept, view)
        astray = state.phase is SolverPhase.LOST and not is_consistent_with_motion(
            state, fit.pose, frame.index
        )
        assessment = assess_pose(fit, state.baseline, support, won == ROTATION_SEARCH, astray)
        if object_map.free_axis is not None:
            fit = replace(fit, pose=object_map.free_axis.untwisted(fit.pose, state.last_pose[0]))
        best = PoseCandidate(view, fit, won, kept, support, assessment)
        if best.lost or (best.doubtful and should_retry(state.doubtful_frames)):
            other = self._elsewhere(state, frame, image, view.mask)
            return other if other is not None and other.better_than(best) else best
        return best

    def _elsewhere(
        self, state: SolverState, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> PoseCandidate | None:
        """The object relocalized in the whole frame, also outside the mask; None if it is not found."""
        where = relocalize_in_frame(
            state.object_map, state.camera, image, (state.trajectory or (state.last_pose,))[-1][0]
        )
        if where is None:
            return None
        pose, points = where
        elsewhere = mask is None or not overlaps_mask(state.object_map.silhouette(pose, state.camera), mask)
        view = self._view(state, frame, None if elsewhere else mask, pose, points)
        _, fit = self._fit(state, view, {RELOCALIZED: pose}, points)
        kept = find_inliers(state.object_map, state.camera, fit.pose, points, view)
        support = pose_evidence(state.object_map, state.camera, fit.pose, kept, view)
        found = PoseCandidate(
            view, fit, RELOCALIZED, kept, support, assess_pose(fit, state.baseline, support, guessed=True)
        )
        return None if found.lost else found

    def _fit(
        self, state: SolverState, view: Keyframe, starts: dict[str, Pose], points: FollowedPoints
    ) -> tuple[str, PoseFit]:
        assert state.surface is not None
        return fit_pose(state.object_map, state.surface, view, starts, points, self.weights)

    def _view(
        self,
        state: SolverState,
        frame: Frame,
        mask: NDArray[np.bool_] | None,
        pose: Pose,
        followed: FollowedPoints,
    ) -> Keyframe:
        """A frame seen from a pose, with the mask weight that follows from the points."""
        on_object = followed.only(~state.object_map.candidate[followed.landmark])
        observation = self._observe(state, frame, mask, pose)
        weight = 1.0 if self.config.object.trust_masks else mask_weight(mask, on_object)
        window = cut_around_object(state.object_map, state.camera, frame.image, mask, pose)
        return Keyframe(observation, mask, pose, followed, mask_weight=weight, image=window)

    def _observe(
        self, state: SolverState, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose
    ) -> Observation:
        return self.observe(frame, mask, pose, state.object_map.vertices, state.camera, state.feature_space)
