"""Estimates the pose of one frame: cheap hypotheses first, then costly ones, then a search of the whole frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import RELOCALIZED
from tracking3d.estimation.observation import Observer
from tracking3d.estimation.online.mapping.keyframe_insertion import view_frame
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.pose_tracking import (
    find_inliers,
    fit_pose,
    follow_points,
    is_consistent_with_motion,
    pixel_scale,
    pose_evidence,
    pose_near,
    pose_of_points,
    pose_predictions,
)
from tracking3d.estimation.online.relocalization import (
    ROTATION_SEARCH,
    overlaps_mask,
    relocalize,
    relocalize_in_frame,
    should_retry,
)
from tracking3d.estimation.online.state.confidence import (
    PoseCandidate,
    assess_pose,
    fits_outline,
    needs_relocalization,
)
from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.frames import Frame
from tracking3d.geometry.pose import Pose

_MOST_ELSEWHERE = 60
"""Inliers from which on the whole frame is not searched: it would have to yield more (34 to 50 on cube_in_hand)."""
BY_POINTS = "points"
"""The name of the pose that the followed points alone have."""
_COARSE = 4, 0
"""Steps of the fit to the pixels after it, see `refine_poses`. From the same states, errors over thirteen clips were
1.23 degrees in the mean without one, 1.08 like this, 1.07 with five finer steps (measured)."""
_FEW_STRAYS, _CLOSE = 0.3, 0.15
"""Outlier ratio and mean loss of points below which they agree so well that nothing else is tried (chosen)."""


@dataclass(frozen=True)
class Tracker:
    """Estimates the pose of an object with a map in one frame."""

    observer: Observer  # how a frame becomes an observation
    weights: PoseWeights  # of a pose's cost terms

    def predict(self, state: Mapped, frame: Frame, mask: NDArray[np.bool_] | None) -> Keyframe:
        """The frame after the state's last one, with its initial mask ``(H, W)``, seen from the likeliest pose."""
        return view_frame(self.observer, state, frame, mask, *follow_points(state, frame))

    def find(
        self,
        state: Mapped,
        view: Keyframe,
        frame: Frame,
        image: NDArray[np.uint8],
        starts: dict[str, Pose] | None = None,
    ) -> PoseCandidate:
        """The pose near the predicted ones, or near given ones if the frame is looked at again.

        It is relocalized if the losses are unusual, and in the whole frame if doubtful; a frame that is looked at again
        was, so that only a lost one is once more. While the object stays lost, frames with a mask are searched as a
        whole at intervals.
        """
        object_map, camera = state.object_map, state.camera
        again = starts is not None
        if starts is None:
            if (settled := self._by_points(state, view)) is not None:
                return settled
            starts = pose_predictions(state, frame.index, view.mask)
        on_object = view.points.only(~object_map.candidate[view.points.landmark])
        points = pose_of_points(object_map, camera, on_object, pixel_scale(view))
        if points is not None:
            starts = {**starts, BY_POINTS: points[0]}
        won, fit = fit_pose(object_map, state.surface, view, starts, view.points, self.weights)
        kept = find_inliers(object_map, camera, fit.pose, view.points, view)
        support = pose_evidence(object_map, camera, fit.pose, kept, view)
        if state.lost or needs_relocalization(fit, state.baseline, support):
            won, fit, kept = relocalize(
                state, view, image, (won, fit, kept), self.weights, self.observer.detector
            )
            support = pose_evidence(object_map, camera, fit.pose, kept, view)
        astray = state.lost and not is_consistent_with_motion(state, fit.pose, frame.index)
        assessment = assess_pose(fit, state.baseline, support, won == ROTATION_SEARCH, astray)
        if object_map.free_axis is not None:
            fit = replace(fit, pose=object_map.free_axis.untwisted(fit.pose, state.last_pose[0]))
        best = PoseCandidate(view, fit, won, kept, support, assessment)
        unsure = best.doubtful and best.evidence.inliers < _MOST_ELSEWHERE
        waited = state.lost_frames if best.lost else state.doubtful_frames
        if (best.lost or (unsure and not again)) and should_retry(waited):
            other = self._elsewhere(state, frame, image, view.mask)
            return other if other is not None and other.better_than(best) else best
        return best

    def attempt(
        self, state: Mapped, view: Keyframe, origin: str, guessed: bool, steps: tuple[int, ...] = (4, 5)
    ) -> PoseCandidate:
        """The candidate from the pose and the points that a view comes with.

        Args:
            state: The state with a map.
            view: The frame seen from that pose.
            origin: What the pose was found by.
            guessed: Whether it is a guess, see `assess_pose`.
            steps: See `refine_poses`.
        """
        object_map, camera, start = state.object_map, state.camera, {origin: view.pose}
        _, fit = fit_pose(object_map, state.surface, view, start, view.points, self.weights, steps)
        kept = find_inliers(object_map, camera, fit.pose, view.points, view)
        support = pose_evidence(object_map, camera, fit.pose, kept, view)
        assessment = assess_pose(fit, state.baseline, support, guessed=guessed)
        return PoseCandidate(view, fit, origin, kept, support, assessment)

    def _by_points(self, state: Mapped, view: Keyframe) -> PoseCandidate | None:
        """The pose by the followed points and a coarse fit to the pixels; None if there are few, or it is doubtful.

        A finer fit would take over what surface, texture and mask are wrong by. Many points that agree within the
        outline settle a pose, whatever the colours do, as under another light.
        """
        pose = None if state.lost else pose_near(state.object_map, state.camera, view)
        if pose is None or state.object_map.free_axis is not None:
            return None
        found = self.attempt(state, replace(view, pose=pose), BY_POINTS, guessed=False, steps=_COARSE)
        fit, support, usual = found.fit, found.evidence, state.baseline
        agree = support.inliers >= _MOST_ELSEWHERE and support.outlier_ratio < _FEW_STRAYS
        if agree and fit.points < _CLOSE and fits_outline(fit, usual) and not found.lost:
            return found
        return None if found.doubtful or needs_relocalization(fit, usual, support) else found

    def _elsewhere(
        self, state: Mapped, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> PoseCandidate | None:
        """The object relocalized in the whole frame, also outside the mask; None if it is not found."""
        last, _ = (state.trajectory or (state.last_pose,))[-1]
        where = relocalize_in_frame(state.object_map, state.camera, image, last, self.observer.detector)
        if where is None:
            return None
        pose, points = where
        elsewhere = mask is None or not overlaps_mask(state.object_map.silhouette(pose, state.camera), mask)
        view = view_frame(self.observer, state, frame, None if elsewhere else mask, pose, points)
        found = self.attempt(state, view, RELOCALIZED, guessed=True)
        return None if found.lost else found
