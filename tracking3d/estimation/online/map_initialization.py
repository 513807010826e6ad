"""Frames wait until they show enough motion for a first map, and are then estimated with it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.features.klt import follow
from tracking3d.estimation.online.first_estimates import estimate_arrived_frames, estimate_pending_frames
from tracking3d.estimation.online.initialization.initial_map import InitialMap, with_contrast
from tracking3d.estimation.online.initialization.initializer import (
    add_pending_frame,
    restart_if_misfit,
    try_initialize,
)
from tracking3d.estimation.online.map_extension import MapExtension
from tracking3d.estimation.online.mapping.free_axis import as_surface_of_revolution
from tracking3d.estimation.online.mapping.keyframe_insertion import refine_local_map
from tracking3d.estimation.online.mapping.landmark_refinement import refine_by_landmarks
from tracking3d.estimation.online.masks.frame_estimates import initial_estimate
from tracking3d.estimation.online.masks.mask_agreement import measure_mask_agreement
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.confidence import LossBaseline
from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.frames import Frame
from tracking3d.runtime.background_attempt import BackgroundAttempt
from tracking3d.runtime.stage_times import in_stage

_LOOKS_FLAT = (
    "all points seen so far lie in one plane; if the whole object is flat, --flat estimates its back better"
)
_RESTARTED = "restarted"  # what the first poses come from, see `FrameEstimate.hypothesis`
_ASKED = 4  # keyframes between two questions whether the object is a surface of revolution (chosen)
_IN_PROGRESS = "the first map is being computed"
Pending = tuple[Keyframe, FrameEstimate]
"""A frame that waits for the first map, and its estimate so far."""
_FIRST_WAIT = 0.03
"""Seconds that an attempt in the background is waited for: most find at once that the motion is too small."""


@dataclass(frozen=True)
class MapInitialization(MapExtension):
    """Makes the first map."""

    # whether the first map is computed in another thread; the result then depends on the machine
    in_background: bool = field(default=False, kw_only=True)

    def for_live_source(self) -> Self:
        """The solver for a source that does not wait; see `tracking3d.estimation.solver.LiveSolver`."""
        return replace(self, in_background=True)

    def finish_background_work(self, state: SolverState) -> tuple[SolverState, FrameEstimate | None]:
        """See `tracking3d.estimation.solver.LiveSolver`; an attempt that has failed is given up."""
        begun = state.background
        if begun is None or not begun.is_done(wait=None):
            return state, None
        return (replace(state, background=None), None) if begun.has_failed else self._adopt(state, begun)

    def _add_pending(
        self, state: SolverState, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> tuple[SolverState, FrameEstimate]:
        """Add a frame to the pending ones, and initialize the map if they show enough motion."""
        assert state.pending is not None
        pose = state.last_pose[0]
        view = self._view(state, frame, mask, pose, follow(state.grey, image, state.tracked_points))
        object_map, view = add_pending_frame(
            state.object_map, tuple(v for v, _ in state.pending), view, image
        )
        estimate = initial_estimate(frame, mask, pose, state.camera)
        updated = replace(state, object_map=object_map, pending=(*state.pending, (view, estimate)))
        updated = updated.advanced(pose, frame.index, image, view.points)
        if self.in_background:
            return self._initialize_in_background(updated, (view, estimate))
        updated, found = self._try_to_initialize(updated)
        return updated, self._with_reason(updated, estimate) if found is None else found

    def _try_to_initialize(self, state: SolverState) -> tuple[SolverState, FrameEstimate | None]:
        """Initialize the map if the pending frames determine it; None if they do not."""
        with in_stage("map"):
            state, start = try_initialize(state, self.online)
        return (state, None) if start is None else self._initialize(state, start)

    def _initialize(self, state: SolverState, start: InitialMap) -> tuple[SolverState, FrameEstimate]:
        """Make the first map, and estimate all pending frames with it."""
        if start.object_map.pointless and state.feature_space is not None:
            space = state.feature_space.with_contrast()
            state = replace(state, feature_space=space)
            views = tuple(with_contrast(view, space) for view in start.object_map.keyframes)
            start = replace(start, object_map=replace(start.object_map, keyframes=views))
        assert state.pending is not None
        everything = list(range(len(start.object_map.keyframes)))
        waiting, before, camera = (*state.rested, *state.pending), state.camera, start.camera
        with in_stage("map"):
            object_map = refine_local_map(
                start.object_map, camera, everything, self.online, bundle_iterations=20, rounds=3
            )
            updated = replace(
                state,
                camera=camera,
                object_map=object_map,
                surface=object_map.surface(),
                pending=None,
                rested=(),
                revisable=waiting if start.object_map.pointless and not self.in_background else (),
            )
            updated = refine_by_landmarks(updated, self.online)
            if self.config.has_given_masks:
                updated = measure_mask_agreement(updated)
            updated, revised = estimate_pending_frames(
                updated, waiting, start.origin, before, self.online, self.weights
            )
        estimate = replace(revised[-1], revised=tuple(revised[:-1]))
        if start.origin == "flat" and not self.config.object.flat and not estimate.reason:
            estimate = replace(estimate, reason=_LOOKS_FLAT)
        return updated, estimate

    def _restart_if_misfit(self, state: SolverState) -> tuple[SolverState, tuple[FrameEstimate, ...]]:
        """The state before the next frame, and new estimates of earlier ones if its map is restarted.

        See `restart_if_misfit`. A live source would wait for seconds, so there it stays.
        """
        if self.in_background:
            return state, ()
        with in_stage("map"):
            updated = restart_if_misfit(state, self.online)
            if updated.object_map is state.object_map or not state.revisable:
                return updated, ()
            updated, revised = estimate_pending_frames(
                updated, state.revisable, _RESTARTED, state.camera, self.online, self.weights
            )
        return updated, tuple(revised)

    def _find_free_axis(self, state: SolverState) -> SolverState:
        """The state before the next frame, with a surface of revolution if its keyframes tell that it is one.

        It is asked at every fourth keyframe. It takes seconds, for which a live source would wait.
        """
        object_map, last = state.object_map, state.object_map.keyframes[-1]
        due = last.index == state.last_pose[1] and len(object_map.keyframes) % _ASKED == 0
        asked = object_map.pointless and object_map.free_axis is None and not object_map.fixed_keyframes
        if self.in_background or state.inactive_maps or not (due and asked):
            return state
        with in_stage("map"):
            weights, others = FitWeights(smoothness=self.online.smoothness), [v for v, _ in state.revisable]
            object_map = as_surface_of_revolution(object_map, weights, others)
        if object_map.free_axis is None:
            return state
        last = object_map.keyframes[-1]
        return replace(
            state,
            object_map=object_map,
            surface=object_map.surface(),
            last_pose=(last.pose, last.index),
            previous_pose=None,
            trajectory=((last.pose, last.index),),
            baseline=LossBaseline(),
        )

    def _initialize_in_background(
        self, state: SolverState, newest: Pending
    ) -> tuple[SolverState, FrameEstimate]:
        """Initialize the map in another thread; the frame keeps its initial mask until that is done."""
        begun = state.background
        if begun is None:
            begun = BackgroundAttempt(
                partial(self._attempt_in_background, state),
                partial(estimate_arrived_frames, before=state.camera, config=self.online, weights=self.weights),
            )  # fmt: skip
            state, wait = replace(state, background=begun), _FIRST_WAIT
        else:
            begun.add(newest)
            wait = 0.0
        if not begun.is_done(wait):
            return state, replace(newest[1], reason=_IN_PROGRESS)
        state, found = self._adopt(state, begun)
        return state, self._with_reason(state, newest[1]) if found is None else found

    def _attempt_in_background(self, state: SolverState) -> tuple[SolverState, list[FrameEstimate]]:
        """The state after an attempt, and the estimates of all pending frames; none if there is no map."""
        state, found = self._try_to_initialize(state)
        return state, [] if found is None else [*found.revised, found]

    def _adopt(
        self, state: SolverState, begun: BackgroundAttempt[SolverState, Pending, FrameEstimate]
    ) -> tuple[SolverState, FrameEstimate | None]:
        """The state with what came of an initialization, as if no frame had come meanwhile."""
        outcome = begun.outcome()
        found, estimates = outcome.state, outcome.results
        if not estimates:
            assert found.pending is not None
            at_rest = found.object_map.started_at_rest
            return replace(
                state,
                object_map=replace(state.object_map, started_at_rest=at_rest),
                pending=(*found.pending, *outcome.left),
                rested=found.rested,
                next_attempt=found.next_attempt,
                ambiguous_frames=found.ambiguous_frames,
                ambiguous_rotation=found.ambiguous_rotation,
                waiting_reason=found.waiting_reason,
                background=None,
            ), None
        if outcome.left:
            found, more = estimate_arrived_frames(
                found, outcome.left, before=state.camera, config=self.online, weights=self.weights
            )
            estimates = [*estimates, *more]
        found = replace(found, grey=state.grey, background=None)
        return found, replace(estimates[-1], revised=tuple(estimates[:-1]))

    @staticmethod
    def _with_reason(state: SolverState, estimate: FrameEstimate) -> FrameEstimate:
        """The estimate of a pending frame, with the reason why it waits."""
        return replace(estimate, reason=state.waiting_reason or estimate.reason)
