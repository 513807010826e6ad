"""The pose of one frame, by all that can be tried: cheap starts, costly ones, and elsewhere than the mask says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.correction import SIGHTED
from tracking3d.estimation.observation import Observation
from tracking3d.estimation.online.attempt import Attempt
from tracking3d.estimation.online.belief import Belief, View
from tracking3d.estimation.online.judgement import judge, looks_wrong
from tracking3d.estimation.online.mapping import mask_weight
from tracking3d.estimation.online.motion import led_to
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.pose_refinement_types import PoseFit, PoseWeights
from tracking3d.estimation.online.sighting import meets, sighted
from tracking3d.estimation.online.tracking import (
    agreeing,
    fit_pose,
    pixel_scale,
    pose_of_points,
    searched,
    supported,
    worth_trying,
)
from tracking3d.estimation.solver_base import SolverBase
from tracking3d.frames import Frame
from tracking3d.geometry.pose import Pose


@dataclass(frozen=True)
class PoseFinder(SolverBase):
    """Finds an object that is known in a frame."""

    @property
    def online(self) -> OnlineConfig:
        """The solver's own part of the configuration."""
        assert isinstance(self.config.solver, OnlineConfig)
        return self.config.solver

    @property
    def weights(self) -> PoseWeights:
        """Weights of a pose's terms."""
        online = self.online
        return PoseWeights(appearance=online.appearance, outline=online.outline, points=online.points)

    def _found(
        self, state: Belief, view: View, frame: Frame, image: NDArray[np.uint8], starts: dict[str, Pose]
    ) -> Attempt:
        """The pose by cheap starts, by costly ones where it looks wrong, and elsewhere where none is believed."""
        assert state.surface is not None
        known, camera = state.known, state.camera
        on_object = view.points.only(~known.candidate[view.points.landmark])
        points = pose_of_points(known, camera, on_object, pixel_scale(view))
        if points is not None:
            starts = {**starts, "points": points[0]}
        won, fit = self._fit(state, view, starts, view.points)
        kept = agreeing(known, camera, fit.pose, view.points, view)
        support = supported(known, camera, fit.pose, kept, view)
        if state.lost_for or looks_wrong(fit, state.usual, support):
            won, fit, kept = searched(
                known, state.surface, camera, view, image, (won, fit, kept), self.weights, state.lost_for
            )
            support = supported(known, camera, fit.pose, kept, view)
        astray = state.lost_for > 0 and not led_to(state, fit.pose, frame.index)
        judgement = judge(fit, state.usual, support, won == "grid", astray)
        best = Attempt(view, fit, won, kept, support, judgement)
        if best.lost or (best.doubtful and worth_trying(state.doubted_for)):
            other = self._elsewhere(state, frame, image, view.mask)
            return other if other is not None and other.better_than(best) else best
        return best

    def _elsewhere(
        self, state: Belief, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> Attempt | None:
        """The object somewhere else in the frame than the mask; None where it is not seen there either."""
        where = sighted(state.known, state.camera, image, (state.trail or (state.last,))[-1][0])
        if where is None:
            return None
        pose, points = where
        elsewhere = mask is None or not meets(state.known.silhouette(pose, state.camera), mask)
        view = self._view(state, frame, None if elsewhere else mask, pose, points)
        _, fit = self._fit(state, view, {SIGHTED: pose}, points)
        kept = agreeing(state.known, state.camera, fit.pose, points, view)
        support = supported(state.known, state.camera, fit.pose, kept, view)
        found = Attempt(view, fit, SIGHTED, kept, support, judge(fit, state.usual, support, guessed=True))
        return None if found.lost else found

    def _fit(
        self, state: Belief, view: View, starts: dict[str, Pose], points: FollowedPoints
    ) -> tuple[str, PoseFit]:
        assert state.surface is not None
        return fit_pose(state.known, state.surface, view, starts, points, self.weights)

    def _view(
        self,
        state: Belief,
        frame: Frame,
        mask: NDArray[np.bool_] | None,
        pose: Pose,
        followed: FollowedPoints,
    ) -> View:
        """A frame as it is seen from a pose, with its mask judged by the points."""
        on_object = followed.only(~state.known.candidate[followed.landmark])
        observation = self._observe(state, frame, mask, pose)
        return View(observation, mask, pose, followed, mask_weight=mask_weight(mask, on_object))

    def _observe(
        self, state: Belief, frame: Frame, mask: NDArray[np.bool_] | None, pose: Pose
    ) -> Observation:
        return self.observe(frame, mask, pose, state.known.vertices, state.camera, state.space)
