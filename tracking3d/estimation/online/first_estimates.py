"""The estimates of the frames that waited for the first map, with that map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.initialization.initial_map import with_contrast
from tracking3d.estimation.online.mapping.focal_length import with_focal_length
from tracking3d.estimation.online.mapping.keyframe_insertion import needs_keyframe, refine_local_map
from tracking3d.estimation.online.masks.frame_estimates import learn_colours, make_estimate
from tracking3d.estimation.online.optimization.types import PoseWeights
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS, PoseCandidate, assess_pose
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.estimation.online.tracking.motion_model import TRAJECTORY_LENGTH
from tracking3d.estimation.online.tracking.pose_tracking import (
    find_inliers,
    fit_pose,
    pose_evidence,
    resect_pose,
)
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose

_LAST = "last"  # name of the pose of the frame before, see `pose_predictions`


def estimate_pending_frames(
    state: SolverState,
    waiting: tuple[tuple[Keyframe, FrameEstimate], ...],
    origin: str,
    before: Camera,
    config: OnlineConfig,
    weights: PoseWeights,
) -> tuple[SolverState, list[FrameEstimate]]:
    """Estimate all pending frames with the first map, one after the other.

    The map may have been made from some of them only. Those before these are estimated backwards in time. Those after
    these that show something new become keyframes, so that their points are landmarks by the time that the last frame
    is reached.

    Args:
        state: The state with the first map, as it was refined.
        waiting: The pending frames, and the estimates that they had.
        origin: What the map was found from.
        before: The camera that the frames waited with.
        config: The solver's options.
        weights: Weights of a pose's cost terms.
    """
    poses = {view.index: view.pose for view in state.object_map.keyframes}
    first = state.object_map.keyframes[0]
    known = first.pose, first.index
    earlier = [one for one in waiting if one[0].index < first.index]
    state, backwards, _ = _estimate_in_turn(
        state, earlier[::-1], known, poses, origin, before, config, weights
    )
    state, revised, trail = _estimate_in_turn(
        state, waiting[len(earlier) :], known, poses, origin, before, config, weights
    )
    return replace(state, previous_pose=trail[-2]), [*backwards[::-1], *revised]


def estimate_arrived_frames(
    state: SolverState,
    arrived: Sequence[tuple[Keyframe, FrameEstimate]],
    before: Camera,
    config: OnlineConfig,
    weights: PoseWeights,
) -> tuple[SolverState, list[FrameEstimate]]:
    """Estimate frames that came while the first map was computed, in the same way.

    Args:
        state: The state with the map, after the frame before them.
        arrived: The frames, at least one, and the estimates that they had.
        before: The camera that they waited with.
        config: The solver's options.
        weights: Weights of a pose's cost terms.
    """
    names = max(int(view.points.landmark.max(initial=-1)) for view, _ in arrived) + 1
    state = replace(state, object_map=_with_room(state.object_map, names), previous_pose=state.last_pose)
    state, revised, trail = _estimate_in_turn(
        state, arrived, state.last_pose, {}, _LAST, before, config, weights
    )
    trajectory = (*state.trajectory, *trail)[-TRAJECTORY_LENGTH:]
    return replace(state, trajectory=trajectory, previous_pose=trajectory[-2]), revised


def _estimate_in_turn(
    state: SolverState,
    waiting: Sequence[tuple[Keyframe, FrameEstimate]],
    known: tuple[Pose, int],
    poses: Mapping[int, Pose],
    origin: str,
    before: Camera,
    config: OnlineConfig,
    weights: PoseWeights,
) -> tuple[SolverState, list[FrameEstimate], list[tuple[Pose, int]]]:
    """Estimate frames one after the other, each from the pose of the one before.

    Args:
        state: The state with the map.
        waiting: The frames, and the estimates that they had.
        known: A pose and the index of its frame; it stays if that is one of the frames.
        poses: The poses of frames that the map was made from, by index.
        origin: What the first poses come from.
        before: The camera that the frames waited with.
        config: The solver's options.
        weights: Weights of a pose's cost terms.

    Returns:
        The state, the estimates, and the frames' poses and indices.
    """
    (pose, fixed), usual, revised, trail = known, state.baseline, list[FrameEstimate](), []
    last = max(poses, default=fixed)
    for seen, earlier in waiting:
        view = with_focal_length(seen, before, state.camera)
        if state.object_map.pointless:
            view = replace(view, points=FollowedPoints.none(), mask_weight=1.0)
        if state.feature_space is not None:
            view = with_contrast(view, state.feature_space)
        assert state.surface is not None
        starts = {origin: poses.get(view.index, pose)}
        fit = fit_pose(state.object_map, state.surface, view, starts, view.points, weights)[1]
        if view.index == fixed:
            fit = replace(fit, pose=starts[origin])
        kept = find_inliers(state.object_map, state.camera, fit.pose, view.points, view)
        evidence = pose_evidence(state.object_map, state.camera, fit.pose, kept, view)
        found = PoseCandidate(view, fit, origin, kept, evidence, assess_pose(fit, usual, evidence))
        if view.index > last and _is_new(state, found, config):
            state = _with_keyframe(state, found, config)
            found = replace(found, fit=replace(fit, pose=state.object_map.keyframes[-1].pose))
        pose, usual = found.fit.pose, usual.update(found.fit)
        trail.append((pose, view.index))
        estimate = make_estimate(state, earlier, found)
        if all(view.index != other.index for other in state.object_map.keyframes):
            shown = resect_pose(state.object_map, state.camera, view, pose)
            estimate = replace(estimate, T_cam_obj=shown.matrix().numpy())
        revised.append(estimate)
        state = learn_colours(state, revised[-1], found)
    if not trail:
        return state, revised, trail
    return replace(
        state, last_pose=trail[-1], trajectory=tuple(trail[-TRAJECTORY_LENGTH:]), baseline=usual,
        tracked_points=view.points,
    ), revised, trail  # fmt: skip


def _with_room(object_map: ObjectMap, names: int) -> ObjectMap:
    """The map with landmarks whose places are not known, so that there are so many."""
    more = max(names - len(object_map.landmarks), 0)
    return replace(
        object_map,
        landmarks=np.concatenate([object_map.landmarks, np.full((more, 3), np.nan)]),
        candidate=np.concatenate([object_map.candidate, np.zeros(more, bool)]),
    )


def _is_new(state: SolverState, found: PoseCandidate, config: OnlineConfig) -> bool:
    """Whether a pending frame is to be a keyframe; without points its pose is no better than the outline."""
    points = found.evidence.inliers >= ENOUGH_POINTS and not state.object_map.pointless
    return points and not found.lost and needs_keyframe(state.object_map, found, config)


def _with_keyframe(state: SolverState, found: PoseCandidate, config: OnlineConfig) -> SolverState:
    """The map with a pending frame as one more keyframe; the points that were tracked into it become landmarks."""
    view = replace(found.view, pose=found.fit.pose, points=found.points)
    object_map = replace(state.object_map, keyframes=(*state.object_map.keyframes, view))
    everything = list(range(len(object_map.keyframes)))
    object_map = refine_local_map(
        object_map, state.camera, everything, config, bundle_iterations=10, rounds=1
    )
    return replace(state, object_map=object_map, surface=object_map.surface())
