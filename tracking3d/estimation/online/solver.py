"""The online solver: track fast, map when it pays, and join matched points with re-rendering.

The loop, frame by frame; the rooms beside this module hold its steps::

    if phase is INITIALIZING:                  # initialization/
        add the frame to the pending ones
        if they show enough motion: make the first map, and estimate all pending frames again
    else:                                      # frame_tracker
        predict the pose by the motion model   # tracking/
        refine it by appearance, outline and tracked points
        if the losses are unusual: relocalize  # relocalization/
        assess the pose, fuse the mask         # state/confidence, masks/
        if the frame is a keyframe:            # mapping/
            insert it, refine the local map, check for a depth reversal
            merge the maps that show the same side  # atlas/
    if phase is LOST:                          # atlas/
        try the inactive maps, else collect frames for a second map
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.estimate import FrameEstimate, ObjectModel, Status
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.gap import PhotoEstimates, PhotoSet
from tracking3d.estimation.online.atlas.atlas import (
    activate_largest_map,
    activate_map,
    guess_alignment,
    map_of_frame,
    mark_unaligned,
    refine_inactive_map,
    switch_map,
    transform_estimates,
)
from tracking3d.estimation.online.atlas.map_alignment import merge_maps
from tracking3d.estimation.online.atlas.reinitialization import (
    colours_match,
    is_fully_visible,
    is_reliable,
    masks_overlap,
    needs_second_map,
)
from tracking3d.estimation.online.features.klt import FollowedPoints, follow, grey
from tracking3d.estimation.online.initialization.initial_map import restart_without_points
from tracking3d.estimation.online.initialization.initializer import (
    try_initialize,
    why_no_map,
)
from tracking3d.estimation.online.initialization.photo_start import (
    MOST_PHOTOS,
    initial_map_of_photos,
    start_of_photos,
)
from tracking3d.estimation.online.initialization.photo_tracks import Photo
from tracking3d.estimation.online.map_initialization import MapInitialization
from tracking3d.estimation.online.mapping.focal_length import state_through_lens
from tracking3d.estimation.online.mapping.free_axis import as_surface_of_revolution
from tracking3d.estimation.online.mapping.global_refinement import refine_globally
from tracking3d.estimation.online.mapping.keyframe_insertion import insert_points
from tracking3d.estimation.online.mapping.keyframe_views import cut_around_object
from tracking3d.estimation.online.mapping.object_model import object_model
from tracking3d.estimation.online.masks.frame_estimates import initial_estimate, make_estimate
from tracking3d.estimation.online.masks.mask_agreement import mask_agreement
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.relocalization.keypoint_matching import poses_from_matches
from tracking3d.estimation.online.relocalization.pose_search import should_retry
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import ONLINE_CLASSES, SolverPhase, SolverState
from tracking3d.estimation.online.tracking.motion_model import (
    TRAJECTORY_LENGTH,
    advance,
    pose_predictions,
)
from tracking3d.estimation.online.tracking.pose_tracking import pixel_scale
from tracking3d.estimation.online.user_guidance import restart_backwards, trust_mask
from tracking3d.estimation.prototype_start import first_mask, first_translation, mask_ellipse, prototype_mesh
from tracking3d.estimation.shape import Shape
from tracking3d.estimation.solver import STATE_CLASSES
from tracking3d.frames import TRACKED_CONFIDENCE, Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_from_arrays
from tracking3d.rendering import TexelMap


@dataclass(frozen=True)
class OnlineSolver(MapInitialization):
    """The solver `online`; implements all protocols of `tracking3d.estimation.solver`."""

    state_classes: ClassVar[tuple[type, ...]] = (*STATE_CLASSES, *ONLINE_CLASSES)
    """The classes that a `SolverState` consists of, for checkpoints."""

    def init(self, frame: Frame, mask: MaskEstimate) -> tuple[SolverState, FrameEstimate]:
        """Take the first frame, with the prototype as the shape.

        Raises:
            InputError: If the first frame's mask is missing or empty, or the prototype cannot be used.
        """
        return self._first_state(mask.on(frame), first_mask(frame, mask), self.camera)

    def _first_state(
        self, frame: Frame, binary: NDArray[np.bool_], camera: Camera, space: FeatureSpace | None = None
    ) -> tuple[SolverState, FrameEstimate]:
        """The state after a first frame; ``space`` is the feature space, if there is one already."""
        ellipse = mask_ellipse(binary)
        translation = torch.tensor(first_translation(ellipse, camera), dtype=torch.float32)
        pose = Pose.identity(translation.to(self.device))
        shape = Shape.of(prototype_mesh(self.config.object, ellipse), self.config.object.flat, self.device)
        texels = TexelMap.of(shape.face_uvs, self.config.object.texture_size)
        object_map = ObjectMap(
            shape,
            texels,
            shape.rest,
            np.zeros((0, 3)),
            (),
            np.zeros(0, bool),
            renderer=self.config.runtime.renderer,
        )
        image = grey(frame.image)
        state = SolverState(camera, object_map, None, (pose, frame.index), None, image, FollowedPoints.none())
        observation = self._observe(state, frame, binary, pose)
        if space is None:
            channels = feature_channels(self.encoder, self.config.object.texture_channels)
            space = FeatureSpace.of(observation.features, observation.mask, channels)
        observation = replace(observation, features=space.project(observation.features, observation.image))
        window = cut_around_object(object_map, camera, frame.image, binary, pose)
        view = Keyframe(observation, binary, pose, FollowedPoints.none(), image=window)
        object_map, view = insert_points(object_map, camera, view, image)
        estimate = initial_estimate(frame, binary, pose, camera)
        state = replace(
            state,
            object_map=object_map,
            feature_space=space,
            tracked_points=view.points,
            pending=((view, estimate),),
        )
        return state, estimate

    def step(self, state: SolverState, frame: Frame, mask: MaskEstimate) -> tuple[SolverState, FrameEstimate]:
        """Take one more frame."""
        frame, binary, image = mask.on(frame), mask.found, grey(frame.image)
        if state.phase is SolverPhase.INITIALIZING:
            return self._add_pending(state, frame, image, binary)
        state, revised = self._restart_if_misfit(state)
        state = self._find_free_axis(state)
        state, estimate = self._track(state, frame, image, binary)
        if binary is not None and needs_second_map(state, image, binary):
            state, estimate = self._recover(state, estimate, frame, binary)
        estimate = replace(estimate, revised=(*revised, *estimate.revised))
        return state, mark_unaligned(estimate) if state.unaligned else estimate

    restart_backwards = staticmethod(restart_backwards)
    trust_mask = staticmethod(trust_mask)

    def refine(self, state: SolverState) -> SolverState:
        """Refine all keyframes together; if the map is not initialized yet, initialize it from the pending frames."""
        state, _ = self.finish_background_work(state)
        if state.phase is SolverPhase.INITIALIZING:
            state, start = try_initialize(state, self.online, ended=True)
            if start is None:
                return replace(state, waiting_reason=why_no_map(state))
            state, _ = self._initialize(state, start)
        state = merge_maps(state, self.online, state.object_map.keyframes)
        state = activate_largest_map(
            replace(state, spans=(*state.spans, (state.active_since, state.last_pose[1])))
        )
        object_map, camera = state.object_map, state.camera
        if object_map.pointless and not object_map.fixed_keyframes:
            weights = FitWeights(smoothness=self.online.smoothness)
            others = [view for view, _ in state.revisable]
            object_map = as_surface_of_revolution(object_map, weights, others)
            if object_map.free_axis is None:
                object_map = restart_without_points(object_map, camera, weights)
                object_map = as_surface_of_revolution(object_map, weights, others)
        object_map, camera = refine_globally(object_map, camera, self.online)
        if self.config.has_given_masks:
            state = replace(state, mask_agreement=mask_agreement(object_map, camera))
        return replace(
            state,
            inactive_maps=tuple(
                refine_inactive_map(other, state.camera, camera, self.online) for other in state.inactive_maps
            ),
            unaligned=False,
            camera=camera,
            object_map=object_map,
            surface=object_map.surface(),
            previous_pose=None,
            lost_frames=0,
            doubtful_frames=0,
            trajectory=state.trajectory and ((object_map.keyframes[0].pose, object_map.keyframes[0].index),),
            tracked_points=FollowedPoints.none(),
        )

    def refine_frame(
        self, state: SolverState, frame: Frame, mask: MaskEstimate, T_cam_obj: NDArray[np.float64]
    ) -> tuple[SolverState, FrameEstimate]:
        """Estimate a frame's pose again, with the final map."""
        state, frame = map_of_frame(state, frame.index), mask.on(frame)
        binary, image, object_map = mask.found, grey(frame.image), state.object_map
        T_cam_obj = state.extended.get(frame.index, T_cam_obj)
        causal = pose_from_arrays(T_cam_obj[:3, :3], T_cam_obj[:3, 3], object_map.vertices)
        if state.surface is None:
            waiting = initial_estimate(frame, binary, causal, state.camera)
            return state, replace(waiting, reason=state.waiting_reason or waiting.reason, refined=True)
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
        found = self._find(state, self._view(state, frame, binary, causal, followed), frame, image, starts)
        before = state.last_pose if state.last_pose[1] == frame.index - 1 else None
        updated = replace(advance(state, found, found.fit.pose, image), previous_pose=before)
        if not found.lost:
            updated = replace(
                updated, trajectory=(*state.trajectory, (found.fit.pose, frame.index))[-TRAJECTORY_LENGTH:]
            )
        if found.lost:  # no better pose than the causal one was found
            found = replace(found, fit=replace(found.fit, pose=causal))
        estimate = make_estimate(
            updated, initial_estimate(frame, binary, found.fit.pose, state.camera), found
        )
        return updated, replace(mark_unaligned(estimate) if state.unaligned else estimate, refined=True)

    def has_points(self, state: SolverState, ended: bool) -> bool:
        """See `tracking3d.estimation.solver.PhotoSolver`."""
        if state.phase is SolverPhase.INITIALIZING:
            start = try_initialize(state, self.online, ended=True)[1] if ended else None
            return start is not None and not start.object_map.pointless
        maps = [state.object_map, *(other.object_map for other in state.inactive_maps)]
        return not all(one.pointless for one in maps)

    def start_from_photos(self, state: SolverState, photos: PhotoSet) -> tuple[SolverState, PhotoEstimates]:
        """See `tracking3d.estimation.solver.PhotoSolver`."""
        places = np.linspace(0, len(photos.indices) - 1, min(MOST_PHOTOS, len(photos.indices)))
        chosen = [photos.indices[place] for place in places.round().astype(int)]
        begun: SolverState | None = None
        found, waiting = list[Photo](), list[tuple[Keyframe, FrameEstimate]]()
        for frame, mask in photos.read(chosen):
            frame, binary = mask.on(frame), mask.found
            if binary is None:
                continue
            if begun is None:
                space = state.feature_space and replace(state.feature_space, contrast=0.0)
                begun, _ = self._first_state(frame, binary, self.camera, space)
            depth = first_translation(mask_ellipse(binary), self.camera)
            pose = Pose.identity(torch.tensor(depth, dtype=torch.float32, device=self.device))
            view = self._view(begun, frame, binary, pose, FollowedPoints.none())
            waiting.append((view, initial_estimate(frame, binary, pose, self.camera)))
            found.append(Photo.of(frame.index, grey(frame.image), binary))
        start = start_of_photos(found, self.camera)
        if begun is None or start.structure is None:
            return replace(state, waiting_reason=start.reason), PhotoEstimates((), start.reason)
        weights = FitWeights(smoothness=self.online.smoothness)
        views = [view for view, _ in waiting]
        made, shown = initial_map_of_photos(begun.object_map, start, found, views, self.camera, weights)
        pending = tuple((view, estimate) for view, (_, estimate) in zip(shown, waiting, strict=True))
        begun, last = self._initialize(replace(begun, pending=pending), made)
        estimates = [*last.revised, replace(last, revised=())]
        rest = sorted(set(photos.indices) - set(chosen))
        estimates += [
            self._find_photo(begun, frame, mask) for frame, mask in (photos.read(rest) if rest else ())
        ]
        return begun, PhotoEstimates(tuple(estimates), start.reason)

    def _find_photo(self, state: SolverState, frame: Frame, mask: MaskEstimate) -> FrameEstimate:
        """A photo that was not joined, by its matches with the nearest ones that were; lost if there are too few."""
        pose, binary = state.last_pose[0], mask.found
        nearest = sorted(state.object_map.keyframes, key=lambda view: abs(view.index - frame.index))
        matched = []
        if binary is not None:
            [keypoints] = Photo.of(frame.index, grey(frame.image), binary).keypoints
            scale = pixel_scale(nearest[0])
            matched = poses_from_matches(state.object_map, state.camera, keypoints, nearest[:4], scale)
        estimate = initial_estimate(frame, binary, matched[0][0] if matched else pose, state.camera)
        decisive = bool(matched) and len(matched[0][1]) >= ENOUGH_POINTS
        return replace(estimate, confidence=TRACKED_CONFIDENCE if decisive else 0.0)

    def result(self, state: SolverState) -> ObjectModel:
        """The object with its visible texture back-projected from the keyframes."""
        state, _ = self.finish_background_work(state)
        if state.inactive_maps:
            state = activate_largest_map(state)
        object_map = state.object_map
        if not object_map.keyframes:
            object_map = replace(object_map, keyframes=tuple(view for view, _ in state.pending or ()))
        return object_model(object_map, state.surface or object_map.surface())

    def _recover(
        self, state: SolverState, estimate: FrameEstimate, frame: Frame, mask: NDArray[np.bool_]
    ) -> tuple[SolverState, FrameEstimate]:
        """Relocalize a lost object in an inactive map that knows this side, or collect frames for a second map.

        Args:
            state: After the frame, in which the object is lost.
            estimate: Of the frame.
            frame: The frame.
            mask: ``(H, W)`` its initial mask.
        """
        image = grey(frame.image)
        searched = state.phase is SolverPhase.LOST and should_retry(state.lost_frames)
        for other in state.inactive_maps if searched else ():
            updated, found = self._track(activate_map(state, other, frame.index), frame, image, mask)
            if found.diagnostics["inliers"] >= ENOUGH_POINTS and found.status is not Status.LOST:
                return updated, found
        begun, last = state.reinitialization, None
        if begun is not None and begun.pending:
            last = begun.pending[-1][0].mask
        if begun is None or not masks_overlap(last, mask):
            if not is_fully_visible(mask) or not colours_match(state, frame, mask):
                return replace(state, reinitialization=None), estimate
            second = self._first_state(frame, mask, state.camera, state.feature_space)[0]
            return replace(state, reinitialization=second), estimate
        begun, again = self._add_pending(begun, frame, image, mask)
        if begun.phase is SolverPhase.INITIALIZING:
            return replace(state, reinitialization=begun), estimate
        if not is_reliable(begun, again):
            return replace(state, reinitialization=None), estimate
        state = state_through_lens(state, begun.camera)
        similarity = guess_alignment(state, begun)
        switched = switch_map(state, begun, similarity)
        again = transform_estimates(again, similarity, state.camera)
        if state.object_map.pointless:  # nothing is held to a map that was doubted all the time
            return replace(switched, inactive_maps=state.inactive_maps, unaligned=False), again
        return switched, mark_unaligned(again)
