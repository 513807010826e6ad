"""Maps that show the same side of the object are aligned by shared landmarks and merged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tracking3d.config.solvers import OnlineConfig
from tracking3d.estimation.online.atlas.map_merging import (
    match_landmarks,
    merge,
    transform_map,
    transform_pose,
)
from tracking3d.estimation.online.features.klt import MOST_FOLLOWED, FollowedPoints
from tracking3d.estimation.online.mapping.global_refinement import keyframe_cost
from tracking3d.estimation.online.mapping.keyframe_insertion import refine_local_map
from tracking3d.estimation.online.relocalization.keypoint_matching import poses_from_matches
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS, LossBaseline
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import InactiveMap, SolverState
from tracking3d.estimation.online.tracking.pose_tracking import pixel_scale
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import pose_arrays
from tracking3d.geometry.similarity import Similarity

_MIN_SHARED_LANDMARKS = 6  # fewest shared landmarks for the transform between two maps
_MAX_COMPARED = 24  # most keyframes of another map that a keyframe is compared with
_MAX_COST_RATIO = 1.2  # ratio of the keyframe costs up to which two maps are merged


def merge_maps(state: SolverState, config: OnlineConfig, views: tuple[Keyframe, ...]) -> SolverState:
    """The state after merging the active map with every map that some of its keyframes can be aligned to.

    Args:
        state: The state between two frames; its last frame is the newest keyframe.
        config: The solver's options.
        views: The keyframes of the active map that are compared with the others.
    """
    indices = {view.index for view in views}
    for other in state.inactive_maps:
        # Merging renumbers the landmarks, so the views change as well.
        for view in (view for view in state.object_map.keyframes if view.index in indices):
            similarity = _estimate_alignment(state.object_map, other.object_map, state.camera, view)
            object_map = (
                None if similarity is None else _merge_pair(state, other.object_map, similarity, config)
            )
            if similarity is not None and object_map is not None:
                state = _with_merged_map(state, other, similarity, object_map)
                break
    return state


def _estimate_alignment(
    object_map: ObjectMap, other: ObjectMap, camera: Camera, view: Keyframe
) -> Similarity | None:
    """The similarity from one map to another by the landmarks that one view shows of both; None if it shows too few."""
    count = len(other.keyframes)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MAX_COMPARED)).round().astype(int))
    compared = [other.keyframes[position] for position in chosen]
    found = poses_from_matches(other, camera, view.keypoints, compared, pixel_scale(view))
    if not found or len(found[0][1]) < ENOUGH_POINTS:
        return None
    pose, points = found[0]
    gap = np.linalg.norm(points.pixel[:, None] - view.keypoints.pixel[None], axis=2)
    label = np.where(gap.min(1) < 0.5, view.keypoint_landmark[gap.argmin(1)], -1)
    x_other, x_known = other.landmarks[points.landmark], object_map.landmarks[label]
    sound = (
        (label >= 0)
        & ~object_map.candidate[label]
        & np.isfinite(x_known).all(1)
        & np.isfinite(x_other).all(1)
    )
    if np.count_nonzero(sound) < _MIN_SHARED_LANDMARKS:
        return None
    x_other, x_known = x_other[sound], x_known[sound]
    R = pose_arrays(pose)[0].T @ pose_arrays(view.pose)[0]
    centre_other, centre_known = np.median(x_other, 0), np.median(x_known, 0)
    spread_other = np.median(np.linalg.norm(x_other - centre_other, axis=1))
    scale = float(spread_other / max(np.median(np.linalg.norm(x_known - centre_known, axis=1)), 1e-9))
    return Similarity(R, scale, np.median(x_other - scale * x_known @ R.T, 0))


def _merge_pair(
    state: SolverState, other: ObjectMap, similarity: Similarity, config: OnlineConfig
) -> ObjectMap | None:
    """Both maps as one, if that explains their keyframes nearly as well as two maps do."""
    camera, second = state.camera, transform_map(state.object_map, similarity)
    pairs = match_landmarks(other, second, camera)
    if len(pairs) < _MIN_SHARED_LANDMARKS:
        return None
    most = max(config.max_keyframes, len(other.keyframes))
    object_map = merge(other, second, pairs, most)
    everything = list(range(len(object_map.keyframes)))
    object_map = refine_local_map(object_map, camera, everything, config, bundle_iterations=20, rounds=3)
    alone = max(keyframe_cost(other), keyframe_cost(state.object_map))
    return object_map if keyframe_cost(object_map) < _MAX_COST_RATIO * alone else None


def _with_merged_map(
    state: SolverState, other: InactiveMap, similarity: Similarity, object_map: ObjectMap
) -> SolverState:
    newest = object_map.keyframes[-1]
    at_newest = newest.index == state.last_pose[1]
    last = newest.pose if at_newest else transform_pose(state.last_pose[0], similarity)
    points = newest.points.spread_out(MOST_FOLLOWED, float(newest.observation.window.side))
    before = state.previous_pose
    usual = other.baseline if other.baseline.frames > state.baseline.frames else state.baseline
    return replace(
        state,
        object_map=object_map,
        surface=object_map.surface(),
        last_pose=(last, state.last_pose[1]),
        previous_pose=before and (transform_pose(before[0], similarity), before[1]),
        trajectory=tuple((transform_pose(pose, similarity), index) for pose, index in state.trajectory),
        tracked_points=points if at_newest else FollowedPoints.none(),
        baseline=usual if usual.frames else LossBaseline(),
        motion_references=(),
        inactive_maps=tuple(one for one in state.inactive_maps if one is not other),
        spans=(*state.spans, *other.spans),
        unaligned=state.unaligned and other.unaligned,
        reversal_attempt=(0, 0.0),
    )
