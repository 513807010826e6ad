"""The initializer: frames wait until they show enough motion for a first map, and are then estimated with it.

What decides about that is in `initialization`. A live source does not wait for it: the map is then made in another
thread, and frames that come meanwhile are estimated when it is done.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.feature_space import FeatureSpace, feature_channels
from tracking3d.estimation.observation import Observer
from tracking3d.estimation.online.features.klt import (
    FollowedPoints,
    follow,
    grey,
    has_texture,
    texture_strength,
)
from tracking3d.estimation.online.features.sift import SIFT, Detector
from tracking3d.estimation.online.initialization.initial_map import (
    InitialMap,
    restart_without_points,
    with_contrast,
)
from tracking3d.estimation.online.initialization.pending_frames import (
    add_pending_frame,
    try_initialize,
    why_no_map,
)
from tracking3d.estimation.online.initialization.photo_start import (
    MOST_PHOTOS,
    initial_map_of_photos,
    start_of_photos,
)
from tracking3d.estimation.online.initialization.photo_tracks import Photo
from tracking3d.estimation.online.mapping.focal_length import with_focal_length
from tracking3d.estimation.online.mapping.free_axis import look_revolved
from tracking3d.estimation.online.mapping.global_refinement import refine_by_landmarks
from tracking3d.estimation.online.mapping.keyframe_insertion import (
    cut_around_object,
    insert_points,
    needs_keyframe,
    refine_local_map,
    view_frame,
)
from tracking3d.estimation.online.masks import (
    initial_estimate,
    learn_colours,
    make_estimate,
    measure_mask_agreement,
)
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.pose_tracking import (
    TRAJECTORY_LENGTH,
    find_inliers,
    fit_pose,
    pixel_scale,
    pose_evidence,
    resect_pose,
)
from tracking3d.estimation.online.relocalization import poses_from_matches
from tracking3d.estimation.online.state.confidence import (
    ENOUGH_POINTS,
    LossBaseline,
    PoseCandidate,
    assess_pose,
)
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import Initializing, Mapped, SolverState
from tracking3d.estimation.shape import Shape, first_translation, mask_ellipse, prototype_mesh
from tracking3d.estimation.solver import PhotoEstimates, PhotoSet
from tracking3d.frames import TRACKED_CONFIDENCE, Frame, MaskEstimate
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.rendering import TexelMap
from tracking3d.runtime.background_attempt import BackgroundAttempt
from tracking3d.runtime.stage_times import in_stage

_PLAIN = "the object has hardly any texture: no points join its photos"
_REVOLVED = "it looks the same from all sides: its turns about its axis cannot be seen"
_LOOKS_FLAT = (
    "all points seen so far lie in one plane; if the whole object is flat, --flat estimates its back better"
)
_LASTING_MISFIT = 5  # frames in a row, see `is_misfit` (chosen)
_MOST_RESTARTS = 2  # while frames come; once more after the last one
_RESTARTED = "restarted"  # what the first poses come from, see `FrameEstimate.hypothesis`
_LAST = "last"  # name of the pose of the frame before, see `pose_predictions`
_IN_PROGRESS = "the first map is being computed"
_FIRST_WAIT = 0.03
"""Seconds that an attempt in the background is waited for: most find at once that the motion is too small."""
Pending = tuple[Keyframe, FrameEstimate]
"""A frame that waits for the first map, and its estimate so far."""


@dataclass(frozen=True)
class Initializer:
    """Makes the first map, and estimates the frames that waited for it."""

    observer: Observer  # how a frame becomes an observation
    options: OnlineConfig  # of the online solver
    # whether the first map is computed in another thread; the result then depends on the machine
    in_background: bool

    def begin(
        self, frame: Frame, mask: NDArray[np.bool_], camera: Camera, space: FeatureSpace | None = None
    ) -> tuple[Initializing, FrameEstimate]:
        """The state after a first frame.

        Args:
            frame: The frame.
            mask: ``(H, W)`` its mask, not empty.
            camera: The camera of the full frame.
            space: The feature space, if there is one already.
        """
        observer, config, ellipse = self.observer, self.observer.config, mask_ellipse(mask)
        translation = torch.tensor(first_translation(ellipse, camera), dtype=torch.float32)
        pose = Pose.identity(translation.to(observer.device))
        shape = Shape.of(prototype_mesh(config.object, ellipse), config.object.flat, observer.device)
        texels = TexelMap.of(shape.face_uvs, config.object.texture_size)
        object_map = ObjectMap(
            shape,
            texels,
            shape.rest,
            np.zeros((0, 3)),
            (),
            np.zeros(0, bool),
            renderer=config.runtime.renderer,
        )
        image = grey(frame.image)
        observation = observer.observe(frame, mask, pose, object_map.vertices, camera, None)
        if space is None:
            channels = feature_channels(observer.encoder, config.object.texture_channels)
            space = FeatureSpace.of(observation.features, observation.mask, channels)
        observation = replace(observation, features=space.project(observation.features, observation.image))
        window = cut_around_object(object_map, camera, frame.image, mask, pose)
        view = Keyframe(observation, mask, pose, FollowedPoints.none(), image=window)
        object_map, view = insert_points(object_map, camera, view, image, observer.detector)
        estimate = initial_estimate(frame, mask, pose, camera)
        last = pose, frame.index
        pending = ((view, estimate),)
        return Initializing(camera, object_map, last, image, view.points, space, pending=pending), estimate

    def add(
        self, state: Initializing, frame: Frame, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
    ) -> tuple[SolverState, FrameEstimate]:
        """Add a frame to the pending ones, and make the first map if they show enough motion.

        Args:
            state: After the frame before.
            frame: The frame.
            image: ``(H, W)`` grey.
            mask: ``(H, W)`` its initial mask, or None.
        """
        pose = state.last_pose[0]
        followed = follow(state.grey, image, state.tracked_points)
        view = view_frame(self.observer, state, frame, mask, pose, followed)
        object_map, view = add_pending_frame(
            state.object_map, tuple(v for v, _ in state.pending), view, image, self.observer.detector
        )
        estimate = initial_estimate(frame, mask, pose, state.camera)
        state = replace(
            state,
            object_map=object_map,
            pending=(*state.pending, (view, estimate)),
            last_pose=(pose, frame.index),
            grey=image,
            tracked_points=view.points,
        )
        updated, found = (self._try_in_background if self.in_background else self._try)(state)
        why = updated.waiting_reason if isinstance(updated, Initializing) else ""
        return updated, found or replace(estimate, reason=why or estimate.reason)

    def finish(self, state: Initializing) -> SolverState:
        """The state after the last frame, with a first map if the pending frames determine one."""
        state, start = try_initialize(state, self.options, ended=True)
        if start is None:
            return replace(state, waiting_reason=why_no_map(state))
        return self._make_map(state, start)[0]

    def finish_background_work(self, state: SolverState) -> tuple[SolverState, FrameEstimate | None]:
        """See `tracking3d.estimation.solver.RefiningSolver`; an attempt that has failed is given up."""
        if (begun := state.background) is None or not begun.is_done(wait=None):
            return state, None
        return (replace(state, background=None), None) if begun.has_failed else self._adopt(state, begun)

    def restart_if_misfit(self, state: Mapped) -> tuple[Mapped, tuple[FrameEstimate, ...]]:
        """The state before the next frame, and new estimates of earlier ones if its map is restarted.

        See `restart_if_misfit`. That takes seconds: for a live source it is done in another thread, and frames are
        estimated with the present map meanwhile.
        """
        if not self.in_background:
            return self._restart(state)
        begun = state.background
        if begun is None and not needs_restart(state):
            return state, ()
        begun = begun or self._in_background(state, lambda: self._restart(state))
        if not begun.is_done():
            return replace(state, background=begun), ()
        updated, found = self._adopt(state, begun)
        assert isinstance(updated, Mapped)  # a map never becomes none
        return updated, () if found is None else (*found.revised, replace(found, revised=()))

    def _restart(self, state: Mapped) -> tuple[Mapped, tuple[FrameEstimate, ...]]:
        """See `restart_if_misfit`."""
        with in_stage("map"):
            updated = restart_if_misfit(state, self.options)
            if updated.object_map is state.object_map or not state.revisable:
                return updated, ()
            updated, revised = self._estimate_pending(updated, state.revisable, _RESTARTED, state.camera)
            updated = replace(updated, tried=state.tried + len(revised))
        return updated, tuple(revised)

    def has_points(self, state: SolverState, ended: bool) -> bool:
        """See `tracking3d.estimation.solver.RefiningSolver`."""
        if isinstance(state, Initializing):
            asked = replace(state, needs_points=True)  # else it is fitted here and in `finish`
            start = try_initialize(asked, self.options, ended=True)[1] if ended else None
            return start is not None and not start.object_map.pointless
        maps = [state.object_map, *(other.object_map for other in state.inactive_maps)]
        return not all(one.pointless for one in maps)

    def join_photos(self, state: SolverState, photos: PhotoSet) -> tuple[SolverState, PhotoEstimates]:
        """See `tracking3d.estimation.solver.RefiningSolver.start_from_photos`."""
        from tracking3d.features.keypoint_network import NetworkDetector  # slow to import

        observer, camera = self.observer, self.observer.camera
        known = [view.strength for view in state.object_map.keyframes if view.strength < np.inf]
        if state.object_map.pointless and known and not has_texture(known):
            return state, PhotoEstimates((), _PLAIN)
        places = np.linspace(0, len(photos.indices) - 1, min(MOST_PHOTOS, len(photos.indices)))
        chosen = [photos.indices[place] for place in places.round().astype(int)]
        begun: Initializing | None = None
        own = observer.detector
        detectors = own, NetworkDetector(NetworkDetector.Options()) if own.rotation_invariant else SIFT
        kinds: tuple[list[Photo], ...] = tuple([] for _ in detectors)
        waiting, strengths = list[Pending](), list[float]()
        for frame, mask in photos.read(chosen):
            frame, binary = mask.on(frame), mask.found
            if binary is None:
                continue
            if begun is None:
                space = state.feature_space and replace(state.feature_space, contrast=0.0)
                begun, _ = self.begin(frame, binary, camera, space)
            depth = first_translation(mask_ellipse(binary), camera)
            pose = Pose.identity(torch.tensor(depth, dtype=torch.float32, device=observer.device))
            view = view_frame(observer, begun, frame, binary, pose, FollowedPoints.none())
            waiting.append((view, initial_estimate(frame, binary, pose, camera)))
            for found, detector in zip(kinds, detectors, strict=True):
                found.append(Photo.of(frame.index, grey(frame.image), binary, detector))
            strengths.append(texture_strength(grey(frame.image), binary))
        plain = bool(waiting) and not has_texture(strengths)  # no pair of photos is worth matching
        start = None if plain else start_of_photos(kinds, camera)
        if begun is None or start is None or start.structure is None:
            reason = _PLAIN if start is None else start.reason
            if start is not None and look_revolved([view for view, _ in waiting]):
                reason = f"{len(waiting)} photos, none joined; {_REVOLVED}"
            if isinstance(state, Initializing):
                state = replace(state, waiting_reason=reason)
            return state, PhotoEstimates((), reason)
        weights = FitWeights(smoothness=self.options.smoothness)
        views = [view for view, _ in waiting]
        made, shown = initial_map_of_photos(begun.object_map, start, kinds[0], views, camera, weights)
        pending = tuple((view, estimate) for view, (_, estimate) in zip(shown, waiting, strict=True))
        joined, last = self._make_map(replace(begun, pending=pending), made)
        estimates = [*last.revised, replace(last, revised=())]
        rest = sorted(set(photos.indices) - set(chosen))
        estimates += [
            _find_photo(joined, frame, mask, observer.detector)
            for frame, mask in (photos.read(rest) if rest else ())
        ]
        return joined, PhotoEstimates(tuple(estimates), start.reason)

    def _try(self, state: Initializing) -> tuple[SolverState, FrameEstimate | None]:
        """Make the first map if the pending frames determine it; None if they do not."""
        with in_stage("map"):
            state, start = try_initialize(state, self.options)
        return (state, None) if start is None else self._make_map(state, start)

    def _make_map(self, state: Initializing, start: InitialMap) -> tuple[Mapped, FrameEstimate]:
        """Make the first map, and estimate all pending frames with it."""
        if start.object_map.pointless and state.feature_space is not None:
            space = state.feature_space.with_contrast()
            state = replace(state, feature_space=space)
            views = tuple(with_contrast(view, space) for view in start.object_map.keyframes)
            start = replace(start, object_map=replace(start.object_map, keyframes=views))
        everything = list(range(len(start.object_map.keyframes)))
        waiting, before, camera = (*state.rested, *state.pending), state.camera, start.camera
        with in_stage("map"):
            object_map = refine_local_map(
                start.object_map, camera, everything, self.options, bundle_iterations=20, rounds=3
            )
            updated = Mapped(
                camera,
                object_map,
                state.last_pose,
                state.grey,
                state.tracked_points,
                state.feature_space,
                state.extended,
                surface=object_map.surface(),
                revisable=waiting if start.object_map.pointless else (),
            )
            updated = refine_by_landmarks(updated, self.options)
            if self.observer.config.has_given_masks:
                updated = measure_mask_agreement(updated)
            updated, revised = self._estimate_pending(updated, waiting, start.origin, before)
        estimate = replace(revised[-1], revised=tuple(revised[:-1]))
        if start.origin == "flat" and not self.observer.config.object.flat and not estimate.reason:
            estimate = replace(estimate, reason=_LOOKS_FLAT)
        return updated, estimate

    def _try_in_background(self, state: Initializing) -> tuple[SolverState, FrameEstimate | None]:
        """Make the first map in another thread; the newest frame keeps its initial mask until that is done."""
        begun, newest, wait = state.background, state.pending[-1], 0.0
        if begun is None:

            def attempt() -> tuple[SolverState, Sequence[FrameEstimate]]:
                tried, found = self._try(state)
                return tried, () if found is None else (*found.revised, found)

            begun, wait = self._in_background(state, attempt), _FIRST_WAIT
        else:
            begun.add(newest)
        if begun.is_done(wait):
            return self._adopt(state, begun)
        return replace(state, background=begun), replace(newest[1], reason=_IN_PROGRESS)

    def _in_background(
        self, state: SolverState, attempt: Callable[[], tuple[SolverState, Sequence[FrameEstimate]]]
    ) -> BackgroundAttempt[SolverState, Pending, FrameEstimate]:
        """Make a map in another thread, which then estimates the frames that arrived meanwhile."""

        def arrived(made: SolverState, frames: Sequence[Pending]) -> tuple[SolverState, list[FrameEstimate]]:
            assert isinstance(made, Mapped)  # there are estimates
            return self._estimate_arrived(made, frames, state.camera)

        return BackgroundAttempt(attempt, arrived)

    def _adopt(
        self, state: SolverState, begun: BackgroundAttempt[SolverState, Pending, FrameEstimate]
    ) -> tuple[SolverState, FrameEstimate | None]:
        """The state with the map that was made in another thread, as if no frame had come meanwhile."""
        outcome = begun.outcome()
        found, estimates = outcome.state, outcome.results
        if isinstance(state, Mapped):
            assert isinstance(found, Mapped)  # the outcome of a restart
            if not estimates or found.active_since != state.active_since:  # or another map took its place
                return replace(state, background=None, misfits=0, restarts=found.restarts), None
        elif isinstance(found, Initializing):
            at_rest = found.object_map.started_at_rest
            return replace(
                found,
                object_map=replace(state.object_map, started_at_rest=at_rest),
                last_pose=state.last_pose,
                grey=state.grey,
                tracked_points=state.tracked_points,
                pending=(*found.pending, *outcome.left),
            ), None
        assert isinstance(found, Mapped)  # there are estimates
        if outcome.left:
            found, more = self._estimate_arrived(found, outcome.left, state.camera)
            estimates = [*estimates, *more]
        return replace(found, grey=state.grey), replace(estimates[-1], revised=tuple(estimates[:-1]))

    def _estimate_pending(
        self, state: Mapped, waiting: tuple[Pending, ...], origin: str, before: Camera
    ) -> tuple[Mapped, list[FrameEstimate]]:
        """Estimate all pending frames with the first map, one after the other.

        The map may have been made from some of them only. Those before these are estimated backwards in time. Those
        after these that show something new become keyframes, so that their points are landmarks by the time that the
        last frame is reached.

        Args:
            state: The state with the first map, as it was refined.
            waiting: The pending frames, and the estimates that they had.
            origin: What the map was found from.
            before: The camera that the frames waited with.
        """
        poses = {view.index: view.pose for view in state.object_map.keyframes}
        first = state.object_map.keyframes[0]
        known = first.pose, first.index
        earlier = [one for one in waiting if one[0].index < first.index]
        state, backwards, _ = self._estimate_in_turn(state, earlier[::-1], known, poses, origin, before)
        state, revised, trail = self._estimate_in_turn(
            state, waiting[len(earlier) :], known, poses, origin, before
        )
        return replace(state, previous_pose=trail[-2]), [*backwards[::-1], *revised]

    def _estimate_arrived(
        self, state: Mapped, arrived: Sequence[Pending], before: Camera
    ) -> tuple[Mapped, list[FrameEstimate]]:
        """Estimate frames that came while the first map was computed, at least one, in the same way."""
        names = max(int(view.points.landmark.max(initial=-1)) for view, _ in arrived) + 1
        state = replace(state, object_map=_with_room(state.object_map, names), previous_pose=state.last_pose)
        state, revised, trail = self._estimate_in_turn(state, arrived, state.last_pose, {}, _LAST, before)
        trajectory = (*state.trajectory, *trail)[-TRAJECTORY_LENGTH:]
        return replace(state, trajectory=trajectory, previous_pose=trajectory[-2]), revised

    def _estimate_in_turn(
        self,
        state: Mapped,
        waiting: Sequence[Pending],
        known: tuple[Pose, int],
        poses: Mapping[int, Pose],
        origin: str,
        before: Camera,
    ) -> tuple[Mapped, list[FrameEstimate], list[tuple[Pose, int]]]:
        """Estimate frames one after the other, each from the pose of the one before.

        Args:
            state: The state with the map.
            waiting: The frames, and the estimates that they had.
            known: A pose and the index of its frame; it stays if that is one of the frames.
            poses: The poses of frames that the map was made from, by index.
            origin: What the first poses come from.
            before: The camera that the frames waited with.

        Returns:
            The state, the estimates, and the frames' poses and indices.
        """
        (pose, fixed), usual, revised, trail = known, state.baseline, list[FrameEstimate](), []
        last, weights = max(poses, default=fixed), PoseWeights.of(self.options)
        for seen, earlier in waiting:
            view = with_focal_length(seen, before, state.camera)
            if state.object_map.pointless:
                view = replace(view, points=FollowedPoints.none(), mask_weight=1.0)
            if state.feature_space is not None:
                view = with_contrast(view, state.feature_space)
            starts = {origin: poses.get(view.index, pose)}
            fit = fit_pose(state.object_map, state.surface, view, starts, view.points, weights)[1]
            if view.index == fixed:
                fit = replace(fit, pose=starts[origin])
            kept = find_inliers(state.object_map, state.camera, fit.pose, view.points, view)
            evidence = pose_evidence(state.object_map, state.camera, fit.pose, kept, view)
            found = PoseCandidate(view, fit, origin, kept, evidence, assess_pose(fit, usual, evidence))
            if view.index > last and _is_new(state, found, self.options):
                state = _with_keyframe(state, found, self.options)
                found = replace(found, fit=replace(fit, pose=state.object_map.keyframes[-1].pose))
            pose, usual = found.fit.pose, usual.update(found.fit)
            trail.append((pose, view.index))
            estimate = make_estimate(state, earlier, found)
            if all(view.index != other.index for other in state.object_map.keyframes):
                shown = resect_pose(state.object_map, state.camera, view, pose)
                estimate = replace(estimate, T_cam_obj=shown.matrix().numpy())
            state = learn_colours(state, estimate, found)
            if not self.observer.config.runtime.probabilities:  # of all frames at once they take much memory
                estimate = replace(estimate, probability=None)
            revised.append(estimate)
        if not trail:
            return state, revised, trail
        return replace(
            state, last_pose=trail[-1], trajectory=tuple(trail[-TRAJECTORY_LENGTH:]), baseline=usual,
            tracked_points=view.points,
        ), revised, trail  # fmt: skip


def needs_restart(state: Mapped) -> bool:
    """Whether the map has explained the last frames badly for long, and may be restarted once more."""
    known = state.object_map.fixed_keyframes > 0
    return not known and state.misfits >= _LASTING_MISFIT and state.restarts < _MOST_RESTARTS


def restart_if_misfit(state: Mapped, config: OnlineConfig) -> Mapped:
    """The state before the next frame, its map restarted if that has explained the last frames badly for long.

    It is tried `_MOST_RESTARTS` times at most. The object is then tracked on from the newest keyframe.
    """
    if not needs_restart(state):
        return state
    restarts = state.restarts + 1
    again = state.revisable if restarts < _MOST_RESTARTS else ()
    state = replace(state, misfits=0, restarts=restarts, revisable=again)
    weights = FitWeights(smoothness=config.smoothness)
    object_map = restart_without_points(state.object_map, state.camera, weights)
    if object_map is state.object_map:
        return state
    last = object_map.keyframes[-1]
    return state.with_map(
        object_map,
        last_pose=(last.pose, last.index),
        previous_pose=None,
        trajectory=((last.pose, last.index),),
        baseline=LossBaseline(),
        lost_frames=0,
        last_candidate=None,
        motion_references=(),
    )


def _find_photo(state: Mapped, frame: Frame, mask: MaskEstimate, detector: Detector) -> FrameEstimate:
    """A photo that was not joined, by its matches with the nearest ones that were; lost if there are too few."""
    pose, binary = state.last_pose[0], mask.found
    nearest = sorted(state.object_map.keyframes, key=lambda view: abs(view.index - frame.index))
    matched = []
    if binary is not None:
        keypoints = Photo.of(frame.index, grey(frame.image), binary, detector).keypoints
        scale = pixel_scale(nearest[0])
        matched = poses_from_matches(state.object_map, state.camera, keypoints, nearest[:4], scale)
    estimate = initial_estimate(frame, binary, matched[0][0] if matched else pose, state.camera)
    decisive = bool(matched) and len(matched[0][1]) >= ENOUGH_POINTS
    return replace(estimate, confidence=TRACKED_CONFIDENCE if decisive else 0.0)


def _with_room(object_map: ObjectMap, names: int) -> ObjectMap:
    """The map with landmarks whose places are not known, so that there are so many."""
    more = max(names - len(object_map.landmarks), 0)
    return replace(
        object_map,
        landmarks=np.concatenate([object_map.landmarks, np.full((more, 3), np.nan)]),
        candidate=np.concatenate([object_map.candidate, np.zeros(more, bool)]),
    )


def _is_new(state: Mapped, found: PoseCandidate, config: OnlineConfig) -> bool:
    """Whether a pending frame is to be a keyframe; without points its pose is no better than the outline."""
    points = found.evidence.inliers >= ENOUGH_POINTS and not state.object_map.pointless
    return points and not found.lost and needs_keyframe(state.object_map, found, config)


def _with_keyframe(state: Mapped, found: PoseCandidate, config: OnlineConfig) -> Mapped:
    """The map with a pending frame as one more keyframe; the points that were tracked into it become landmarks."""
    view = replace(found.view, pose=found.fit.pose, points=found.points)
    object_map = replace(state.object_map, keyframes=(*state.object_map.keyframes, view))
    everything = list(range(len(object_map.keyframes)))
    object_map = refine_local_map(
        object_map, state.camera, everything, config, bundle_iterations=10, rounds=1
    )
    return state.with_map(object_map)
