"""The online solver: track fast, map when it pays, and join matched points with re-rendering.

`OnlineSolver.step` is the loop, frame by frame. Its parts do not know one another: `initializer` makes the first map,
`tracker` finds a pose, `mapper` inserts keyframes, `atlas` holds several maps, `refiner` ends a video. What they are
made of stands in the rooms beside them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import OnlineConfig, PipelineConfig
from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status, without_masks
from tracking3d.estimation.observation import Observer
from tracking3d.estimation.online import atlas, refiner
from tracking3d.estimation.online.features.klt import FollowedPoints, carry, follow, grey
from tracking3d.estimation.online.features.sift import SIFT, Detector
from tracking3d.estimation.online.initializer import Initializer
from tracking3d.estimation.online.mapper import adopt_free_axis, insert_frame
from tracking3d.estimation.online.mapping.focal_length import state_through_lens
from tracking3d.estimation.online.mapping.global_refinement import (
    adopt_refinement,
    refine_by_landmarks,
    refine_in_background,
)
from tracking3d.estimation.online.mapping.keyframe_insertion import needs_keyframe, view_frame
from tracking3d.estimation.online.masks import (
    initial_estimate,
    learn_colours,
    make_estimate,
    mask_agreement,
    measure_mask_agreement,
    motion_cue_in_window,
    remember_motion,
)
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.pose_tracking import (
    advance,
    extend_trajectory,
    extrapolate_motion,
    follow_points,
    pose_predictions,
    resect_pose,
)
from tracking3d.estimation.online.relocalization import should_retry
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS, is_high_loss, is_misfit
from tracking3d.estimation.online.state.solver_state import (
    ONLINE_CLASSES,
    Initializing,
    Mapped,
    SolverState,
    thin_out,
)
from tracking3d.estimation.online.tracker import Tracker
from tracking3d.estimation.shape import first_mask
from tracking3d.estimation.solver import (
    STATE_CLASSES,
    Gap,
    ModelCoverage,
    PhotoEstimates,
    PhotoSet,
    RefinedStart,
)
from tracking3d.features.protocol import FeatureEncoder
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_from_arrays
from tracking3d.runtime.stage_times import in_stage

_MIN_MASK_IOU = 0.3
"""IoU of the last pose's silhouette with a correct mask, below which the last pose is discarded."""


@dataclass(frozen=True)
class OnlineSolver:
    """The solver `online`; implements `tracking3d.estimation.solver.RefiningSolver`."""

    config: PipelineConfig  # the pipeline's configuration
    camera: Camera  # the camera of the full frame
    encoder: FeatureEncoder  # the feature encoder
    detector: Detector = SIFT  # what finds keypoints
    # whether the first map is computed in another thread; the result then depends on the machine
    in_background: bool = field(default=False, kw_only=True)

    state_classes: ClassVar[tuple[type, ...]] = (*STATE_CLASSES, *ONLINE_CLASSES)
    """The classes that a `SolverState` consists of, for checkpoints."""

    @property
    def options(self) -> OnlineConfig:
        """The solver's own part of the configuration."""
        assert isinstance(self.config.solver, OnlineConfig)
        return self.config.solver

    @cached_property
    def observer(self) -> Observer:
        """How a frame becomes an observation."""
        return Observer(self.config, self.camera, self.encoder, self.detector)

    @cached_property
    def initializer(self) -> Initializer:
        """Makes the first map."""
        return Initializer(self.observer, self.options, self.in_background)

    @cached_property
    def tracker(self) -> Tracker:
        """Finds the pose in a frame."""
        return Tracker(self.observer, PoseWeights.of(self.options))

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[SolverState, FrameEstimate]:
        """Take the first frame, with the prototype as the shape.

        Raises:
            InputError: If the first frame's mask is missing or empty, or the prototype cannot be used.
        """
        return self.initializer.begin(mask.on(frame), first_mask(frame, mask), self.camera)

    def step(self, state: SolverState, frame: Frame, mask: MaskEstimate) -> tuple[SolverState, FrameEstimate]:
        """Take one more frame."""
        frame, binary, image = mask.on(frame), mask.found, grey(frame.image)
        if isinstance(state, Initializing):
            return self.initializer.add(state, frame, image, binary)
        state, revised = self.initializer.restart_if_misfit(state)
        # A live source would wait for what takes seconds.
        state = adopt_refinement(state) if self.in_background else adopt_free_axis(state, self.options)
        may_insert = not mask.carried and state.refinement is None
        state, estimate = self._track(state, frame, image, binary, self.options, may_insert)
        if binary is not None and atlas.needs_second_map(state, image, binary):
            state, estimate = self._recover(state, estimate, frame, image, binary)
        estimate = replace(estimate, revised=(*revised, *estimate.revised))
        return state, atlas.mark_unaligned(estimate) if state.unaligned else estimate

    def _track(
        self,
        state: Mapped,
        frame: Frame,
        image: NDArray[np.uint8],
        mask: NDArray[np.bool_] | None,
        options: OnlineConfig,
        may_insert: bool = True,
    ) -> tuple[Mapped, FrameEstimate]:
        """Estimate the frame's pose, and insert the frame into the map if it may and shows something new."""
        view = self.tracker.predict(state, frame, mask)
        found = self.tracker.find(state, view, frame, image)
        usual = not (found.lost or is_high_loss(found.fit, state.baseline, found.view.mask_weight))
        reliable = usual or (not found.lost and found.evidence.is_decisive)
        is_keyframe = may_insert and reliable and needs_keyframe(state.object_map, found, options)
        pose = extrapolate_motion(state.trajectory, frame.index) if found.lost else found.fit.pose
        updated = advance(state, found, pose, image)
        if usual:
            updated = replace(updated, baseline=state.baseline.update(found.fit))
        if state.object_map.pointless:
            misfit = is_misfit(found.fit, state.baseline)
            updated = replace(updated, misfits=state.misfits + 1 if misfit else 0)
        if is_keyframe:
            with in_stage("map"):
                view = replace(found.view, pose=pose, points=found.points)
                refine = refine_in_background if self.in_background else refine_by_landmarks
                updated = insert_frame(updated, view, image, options, self.detector, refine)
                updated = atlas.merge_maps(updated, options, updated.object_map.keyframes[-1:])
                if self.config.has_given_masks:
                    updated = measure_mask_agreement(updated)
            pose = updated.last_pose[0]
        if found.lost:
            updated = replace(updated, previous_pose=None)
        elif usual:
            updated = extend_trajectory(updated, pose, frame.index)
        found = replace(found, fit=replace(found.fit, pose=pose))
        plain, now = initial_estimate(frame, mask, pose, state.camera), updated
        estimate = make_estimate(now, plain, found, lambda: motion_cue_in_window(now, found, image))
        updated = remember_motion(learn_colours(updated, estimate, found), estimate, found, image)
        if state.revisable:
            updated = replace(updated, revisable=thin_out((*state.revisable, (found.view, plain))))
        if state.background is not None:
            state.background.add((found.view, plain))
        if not (found.doubtful if state.object_map.pointless else found.lost):
            updated = replace(updated, reinitialization=None)
        if not (found.lost or is_keyframe):
            # Only what is reported: masks and map follow the pose that fits this surface and these outlines.
            pose = resect_pose(state.object_map, state.camera, found.view, pose)
            estimate = replace(estimate, T_cam_obj=pose.matrix().numpy())
        return updated, replace(estimate, keyframe=is_keyframe)

    def _recover(
        self,
        state: Mapped,
        estimate: FrameEstimate,
        frame: Frame,
        image: NDArray[np.uint8],
        mask: NDArray[np.bool_],
    ) -> tuple[Mapped, FrameEstimate]:
        """Relocalize a lost object in an inactive map that knows this side, or collect frames for a second map.

        The state is that after the frame, whose ``image`` ``(H, W)`` is grey; ``mask`` ``(H, W)`` is its initial one.
        """
        searched = state.lost and should_retry(state.lost_frames)
        maps = (state.object_map, *(other.object_map for other in state.inactive_maps))
        if state.tried >= frame.index - min(one.keyframes[0].index for one in maps):
            return replace(state, reinitialization=None), estimate
        state = replace(state, tried=state.tried + 1 + searched * len(state.inactive_maps))
        for other in state.inactive_maps if searched else ():
            other_state = atlas.activate_map(state, other, frame.index)
            updated, found = self._track(other_state, frame, image, mask, self.options)
            if found.diagnostics["inliers"] >= ENOUGH_POINTS and found.status is not Status.LOST:
                return updated, found
        begun = state.reinitialization
        last = begun.pending[-1][0].mask if begun is not None and begun.pending else None
        if begun is None or not atlas.masks_overlap(last, mask):
            if not atlas.is_fully_visible(mask) or not atlas.colours_match(state, frame, mask):
                return replace(state, reinitialization=None), estimate
            begun, _ = self.initializer.begin(frame, mask, state.camera, state.feature_space)
            return replace(state, reinitialization=replace(begun, needs_points=True)), estimate
        second, again = self.initializer.add(begun, frame, image, mask)
        if isinstance(second, Initializing):
            return replace(state, reinitialization=second), estimate
        if not atlas.is_reliable(second, again):
            return replace(state, reinitialization=None), estimate
        state = state_through_lens(state, second.camera)
        similarity = atlas.guess_alignment(state, second)
        switched = atlas.switch_map(state, second, similarity)
        again = atlas.transform_estimates(again, similarity, state.camera)
        if state.object_map.pointless:  # nothing is held to a map that was doubted all the time
            return replace(switched, inactive_maps=state.inactive_maps, unaligned=False), again
        return switched, atlas.mark_unaligned(again)

    def refine(self, state: SolverState) -> SolverState:
        """Refine all keyframes together; if the map is not initialized yet, initialize it from the pending frames."""
        state, _ = self.finish_background_work(state)
        if isinstance(state, Initializing):
            state = self.initializer.finish(state)
        if isinstance(state, Initializing):
            return state
        state = atlas.merge_maps(state, self.options, state.object_map.keyframes)
        state = atlas.activate_largest_map(
            replace(state, spans=(*state.spans, (state.active_since, state.last_pose[1])))
        )
        before, state = state.camera, refiner.refine_active_map(state, self.options)
        if self.config.has_given_masks:
            state = replace(state, mask_agreement=mask_agreement(state.object_map, state.camera))
        others = (
            atlas.refine_inactive_map(other, before, state.camera, self.options)
            for other in state.inactive_maps
        )
        return replace(state, inactive_maps=tuple(others))

    def refine_frame(
        self, state: SolverState, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[SolverState, FrameEstimate]:
        """Estimate a frame's pose again, with the final map."""
        frame, binary, image = mask.on(frame), mask.found, grey(frame.image)
        T_cam_obj = state.extended.get(frame.index, T_cam_obj)
        causal = pose_from_arrays(T_cam_obj[:3, :3], T_cam_obj[:3, 3], state.object_map.vertices)
        if isinstance(state, Initializing):
            waiting = initial_estimate(frame, binary, causal, state.camera)
            return state, replace(waiting, reason=state.waiting_reason or waiting.reason, refined=True)
        state = atlas.map_of_frame(state, frame.index)
        object_map = state.object_map
        starts = {"causal": causal}
        followed = follow(state.grey, image, state.tracked_points)
        own = next((view for view in object_map.keyframes if view.index == frame.index), None)
        if own is not None:
            starts["keyframe"] = own.pose
            followed = own.points.concatenate(followed)
        if state.previous_pose is not None:
            starts |= pose_predictions(state, frame.index, binary)
        elif object_map.free_axis is not None and state.last_pose[1] == frame.index - 1:
            starts["last"] = state.last_pose[0]  # the causal pose may be of a surface that was another one
        view = view_frame(self.observer, state, frame, binary, causal, followed)
        found = self.tracker.find(state, view, frame, image, starts)
        before = state.last_pose if state.last_pose[1] == frame.index - 1 else None
        updated = replace(advance(state, found, found.fit.pose, image), previous_pose=before)
        if found.lost:  # no better pose than the causal one was found
            found = replace(found, fit=replace(found.fit, pose=causal))
        else:
            updated = extend_trajectory(updated, found.fit.pose, frame.index)
        estimate = make_estimate(
            updated, initial_estimate(frame, binary, found.fit.pose, state.camera), found
        )
        return updated, replace(atlas.mark_unaligned(estimate) if state.unaligned else estimate, refined=True)

    def result(self, state: SolverState) -> ObjectModel:
        """The object with its visible texture back-projected from the keyframes."""
        state, _ = self.finish_background_work(state)
        if isinstance(state, Initializing):
            object_map = replace(state.object_map, keyframes=tuple(view for view, _ in state.pending))
            return object_map.model(object_map.surface())
        state = atlas.activate_largest_map(state)
        return state.object_map.model(state.surface)

    def continue_refinement(self, state: SolverState, start: RefinedStart) -> SolverState | None:
        """See `tracking3d.estimation.solver.RefiningSolver`."""
        return refiner.continue_refinement(state, start, self.options)

    keep_frame = staticmethod(refiner.keep_frame)
    keyframe_poses = staticmethod(refiner.keyframe_poses)

    def begin_extension(
        self, state: SolverState, confidence: Mapping[int, float]
    ) -> tuple[SolverState, ModelCoverage] | None:
        """The state with the largest map active, and what it explains; None if it cannot be extended."""
        if isinstance(state, Initializing):
            return None
        last = state.last_pose[1]
        spans = (*state.spans, (state.active_since, last))
        state = atlas.activate_largest_map(replace(state, spans=spans, active_since=last + 1))
        own = {index: confidence[index] for index in atlas.frames_of_map(state, confidence)}
        return refiner.prepare_extension(state, own, self.options)

    def extend(self, state: Mapped, gap: Gap) -> tuple[Mapped, list[FrameEstimate]]:
        """Track the object through a gap, and insert keyframes there; no estimates if its keyframe was culled."""
        if all(view.index != gap.anchor.index for view in state.object_map.keyframes):
            return state, []
        aside, options = state.inactive_maps, refiner.with_more_keyframes(self.options)
        number = max(state.last_pose[1], *(view.index for view in state.object_map.keyframes)) + 1
        state, estimates = refiner.enter_gap(state, gap, number), list[FrameEstimate]()
        ended = replace(self, in_background=False)  # a live source that has ended waits for nothing
        for frame, mask in gap.frames:
            shown = replace(frame, index=number + abs(frame.index - gap.anchor.index))
            state, estimate = ended._track(state, shown, grey(frame.image), mask.found, options)
            estimates.append(replace(without_masks(estimate), index=frame.index))
        return replace(refiner.leave_gap(state, gap, number), inactive_maps=aside), estimates

    end_extension = staticmethod(refiner.end_extension)

    def start_from(self, state: SolverState, poses: Mapping[int, NDArray[np.float64]]) -> SolverState:
        """The state that refines frames from other poses than the causal ones."""
        return replace(state, extended=dict(poses))

    def has_points(self, state: SolverState, ended: bool) -> bool:
        """See `tracking3d.estimation.solver.RefiningSolver`."""
        return self.initializer.has_points(state, ended)

    def start_from_photos(self, state: SolverState, photos: PhotoSet) -> tuple[SolverState, PhotoEstimates]:
        """See `tracking3d.estimation.solver.RefiningSolver`."""
        return self.initializer.join_photos(state, photos)

    def for_live_source(self) -> Self:
        """The solver for a source that does not wait; see `tracking3d.estimation.solver.RefiningSolver`."""
        return replace(self, in_background=True)

    def finish_background_work(self, state: SolverState) -> tuple[SolverState, FrameEstimate | None]:
        """See `tracking3d.estimation.solver.RefiningSolver`."""
        state, found = self.initializer.finish_background_work(state)
        return (adopt_refinement(state, wait=None) if isinstance(state, Mapped) else state), found

    @staticmethod
    def carry_mask(state: SolverState, frame: Frame, mask: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """The last frame's mask ``(H, W)`` in the next one, moved as the tracked points are."""
        if isinstance(state, Initializing):
            return None
        return carry(mask, state.tracked_points, follow_points(state, frame)[1])

    @staticmethod
    def restart_backwards(
        state: SolverState, frame: Frame, number: int, T_cam_obj: NDArray[np.float64]
    ) -> SolverState:
        """The state that continues from an earlier frame, with everything learnt since.

        The next frame's index follows ``number``; the frame's pose ``(4, 4)`` is used if it is no keyframe.
        """
        waiting = state.pending if isinstance(state, Initializing) else ()
        views = [*state.object_map.keyframes, *(view for view, _ in waiting)]
        own = next((view for view in views if view.index == frame.index), None)
        pose = (
            pose_from_arrays(T_cam_obj[:3, :3], T_cam_obj[:3, 3], state.object_map.vertices)
            if own is None
            else own.pose
        )
        points = FollowedPoints.none() if own is None else own.points
        state = replace(state, last_pose=(pose, number), grey=grey(frame.image), tracked_points=points)
        if isinstance(state, Initializing):
            return state
        return replace(
            state,
            reinitialization=None,
            previous_pose=None,
            lost_frames=0,
            doubtful_frames=0,
            trajectory=((pose, number),),
            motion_references=(),
        )

    @staticmethod
    def trust_mask(state: SolverState, frame: Frame, mask: NDArray[np.bool_]) -> SolverState:
        """The state before a frame whose mask ``(H, W)`` is correct: tracked points that leave the mask are dropped.

        Without inliers against it the mask has full weight. If the last pose is elsewhere, the object was lost
        unnoticed: all of its sides are then tried at the mask.
        """
        if isinstance(state, Mapped):
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
