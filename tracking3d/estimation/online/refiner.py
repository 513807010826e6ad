"""The refiner: what is done with the state once the video has ended.

All keyframes are refined together, and frames are then estimated with the final map. Before that, the largest map can
be extended over the frames that it does not explain, from the frames on both sides of them: a video often begins where
the object shows little, or a slip ends one map and begins another, and an object that is known well in some frames can
be tracked from these into the others, backwards as well as forwards. A refinement can also continue from an earlier
one, of which most frames keep their poses, and so does the surface.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.online.features.klt import FollowedPoints, grey
from tracking3d.estimation.online.initialization.initial_map import lead_over_rivals, restart_without_points
from tracking3d.estimation.online.mapping.focal_length import inactive_map_through_lens, with_focal_length
from tracking3d.estimation.online.mapping.free_axis import as_surface_of_revolution
from tracking3d.estimation.online.mapping.global_refinement import refine_globally, refit_without_points
from tracking3d.estimation.online.mapping.keyframe_insertion import prune_landmarks
from tracking3d.estimation.online.mapping.local_mapping import refine_map
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.pose_tracking import extend_trajectory
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import InactiveMap, Initializing, Mapped, SolverState
from tracking3d.estimation.solver import Gap, ModelCoverage, RefinedStart
from tracking3d.frames import TRACKED_CONFIDENCE, Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays

_ROOM = 1.5
"""Factor by which an extended map may have more keyframes."""
_NEVER_REVERSED = (1 << 30, 360.0)
"""A `Mapped.reversal_attempt` after which there is no other: poses of other frames refer to the map as it is."""
_MOST_BENT = 0.25
"""Distance in radii of the object by which the refined surface may lie elsewhere than the map's, as a median: a surface
farther off belongs to another map, or was turned inside out by a depth reversal."""
_BUNDLE_ITERATIONS, _ROUNDS = 15, 2


def refine_active_map(state: Mapped, config: OnlineConfig) -> Mapped:
    """The state for the final estimates, its active map refined with all keyframes and the focal length if assumed."""
    object_map, camera = state.object_map, state.camera
    weights, others = FitWeights(smoothness=config.smoothness), [view for view, _ in state.revisable]
    plain = object_map.pointless and not object_map.fixed_keyframes
    if plain:
        object_map = as_surface_of_revolution(object_map, weights, others)
        if object_map.free_axis is None:
            object_map = restart_without_points(object_map, camera, weights)
            object_map = as_surface_of_revolution(object_map, weights, others)
    if plain and object_map.free_axis is None:
        object_map = refit_without_points(object_map, weights)
        if len(object_map.keyframes) > 1:
            object_map = replace(object_map, lead=lead_over_rivals(object_map, camera, weights))
    else:
        object_map, camera = refine_globally(object_map, camera, config)
    return replace(
        _with_final_map(state, object_map, camera),
        unaligned=False,
        trajectory=state.trajectory and ((object_map.keyframes[0].pose, object_map.keyframes[0].index),),
    )


def _with_final_map(state: Mapped, object_map: ObjectMap, camera: Camera) -> Mapped:
    """The state with a map that frames are estimated with in order of time, the first one next."""
    return state.with_map(
        object_map,
        camera=camera,
        previous_pose=None,
        lost_frames=0,
        doubtful_frames=0,
        trajectory=(),
        tracked_points=FollowedPoints.none(),
    )


def continue_refinement(state: SolverState, start: RefinedStart, config: OnlineConfig) -> Mapped | None:
    """The state with an earlier refinement's surface and poses; None if it has several maps, or another one."""
    if isinstance(state, Initializing) or state.inactive_maps or state.unaligned:
        return None
    object_map = move_to_refined(state.object_map, state.camera, start, config)
    if object_map is None:
        return None
    spans = (*state.spans, (state.active_since, state.last_pose[1]))
    return replace(_with_final_map(state, object_map, start.camera), spans=spans)


def keyframe_poses(state: SolverState) -> dict[int, NDArray[np.float64]]:
    """Refined poses ``(4, 4)`` of the keyframes of a map with points, if the causal poses are all of that map."""
    if isinstance(state, Initializing):
        return {}
    object_map = state.object_map
    one_map = not (state.inactive_maps or state.extended or object_map.fixed_keyframes)
    if object_map.pointless or not one_map:
        return {}
    return {view.index: view.pose.matrix().double().cpu().numpy() for view in object_map.keyframes}


def keep_frame(state: Mapped, frame: Frame, T_cam_obj: NDArray[np.float64]) -> Mapped:
    """Take a frame whose refined pose stands, so that its landmarks are followed into the next one."""
    object_map = state.object_map
    pose = pose_from_arrays(T_cam_obj[:3, :3], T_cam_obj[:3, 3], object_map.vertices)
    before = state.last_pose if state.last_pose[1] == frame.index - 1 else None
    return replace(
        extend_trajectory(state, pose, frame.index),
        last_pose=(pose, frame.index),
        previous_pose=before,
        grey=grey(frame.image),
        tracked_points=project_landmarks(object_map, state.camera, pose),
        lost_frames=0,
        doubtful_frames=0,
    )


def move_to_refined(
    object_map: ObjectMap, camera: Camera, start: RefinedStart, config: OnlineConfig
) -> ObjectMap | None:
    """The map with the refined surface and poses; keyframes without a refined pose are refined to fit them.

    Landmarks move with the vertex that is nearest. Keyframes with a refined pose keep it.

    Args:
        object_map: The map that the causal estimates end with.
        camera: Its camera.
        start: The earlier refinement.
        config: The solver's options.

    Returns:
        None if the refined surface is not this map's.
    """
    if object_map.fixed_keyframes or len(start.vertices) != len(object_map.vertices):
        return None
    before = object_map.vertices.double().cpu().numpy()
    placed = [view for view in object_map.keyframes if view.index in start.refined]
    if not placed:
        return None
    turn = _turn_of_object(*pose_arrays(placed[0].pose), camera, start, placed[0].index)
    moved = before @ turn[:3, :3].T + turn[:3, 3]
    bent = np.linalg.norm(moved - start.vertices, axis=1)
    if np.median(bent) > _MOST_BENT * object_map.radius * start.scale:
        return None
    landmarks = object_map.landmarks @ turn[:3, :3].T + turn[:3, 3]
    known = np.isfinite(landmarks).all(1)
    nearest = cKDTree(moved).query(landmarks[known])[1]
    landmarks[known] += (start.vertices - moved)[nearest]
    keyframes = []
    for view in object_map.keyframes:
        seen = with_focal_length(view, camera, start.camera)
        R, t = pose_arrays(view.pose)
        T = start.predict(view.index, _matrix(R, t), camera.fx)
        keyframes.append(
            replace(seen, pose=pose_from_arrays(T[:3, :3], T[:3, 3], object_map.vertices), texture=None)
        )
    vertices = torch.as_tensor(
        start.vertices, dtype=object_map.vertices.dtype, device=object_map.vertices.device
    )
    object_map = replace(object_map, vertices=vertices, landmarks=landmarks, keyframes=tuple(keyframes))
    object_map = _fit_new_keyframes(object_map, start.camera, start.refined, config)
    return object_map.with_textures()


def project_landmarks(object_map: ObjectMap, camera: Camera, pose: Pose) -> FollowedPoints:
    """The landmarks that a frame shows, at the pixels where its pose puts them: those of the keyframe most like it."""
    R, t = pose_arrays(pose)
    alike = max(object_map.keyframes, key=lambda view: float(np.sum(pose_arrays(view.pose)[0] * R)))
    numbers = np.unique(alike.points.landmark[~object_map.candidate[alike.points.landmark]])
    seen = object_map.landmarks[numbers] @ R.T + t
    ahead = np.isfinite(seen).all(1) & (seen[:, 2] > 0)
    numbers, screen = numbers[ahead], seen[ahead] @ camera.K.T
    return FollowedPoints(numbers, (screen[:, :2] / screen[:, 2:]).astype(alike.points.pixel.dtype))


def _fit_new_keyframes(
    object_map: ObjectMap, camera: Camera, refined: Mapping[int, NDArray[np.float64]], config: OnlineConfig
) -> ObjectMap:
    """The map with the keyframes that have no refined pose, and the surface, fitted to the other keyframes."""
    views = object_map.keyframes
    new = [place for place, view in enumerate(views) if view.index not in refined]
    if not new or object_map.pointless:
        return object_map
    held = [place for place in range(len(views)) if place not in new]
    nearest = sorted(held, key=lambda place: min(abs(place - other) for other in new))
    held = sorted(nearest[: max(config.local_window - len(new), config.local_window // 2)])
    return refine_map(
        object_map,
        camera,
        [*held, *new],
        weights=FitWeights(smoothness=config.smoothness),
        prior=config.surface_prior,
        bundle_iterations=_BUNDLE_ITERATIONS,
        rounds=_ROUNDS,
        fixed=len(held),
    )


def _turn_of_object(
    R: NDArray[np.float64], t: NDArray[np.float64], camera: Camera, start: RefinedStart, index: int
) -> NDArray[np.float64]:
    """``(4, 4)`` the similarity from the map's object coordinates to the refined ones, by a keyframe that has both."""
    T = _matrix(R, t)
    T[:3, 3] *= start.scale
    T[2, 3] *= start.camera.fx / camera.fx
    turn = np.linalg.inv(start.refined[index]) @ T
    turn[:3, :3] *= start.scale
    return turn


def _matrix(R: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def prepare_extension(
    state: Mapped, confidence: Mapping[int, float], config: OnlineConfig
) -> tuple[Mapped, ModelCoverage] | None:
    """The state for an extension of its active map, and what that explains; None if it cannot be extended.

    Keyframes that neither an estimate nor enough landmarks support are removed; the others are refined together, and
    the focal length with them, if it is not given: it may be why the others are not explained.

    Args:
        state: After the last frame, with the largest map active.
        confidence: Of the estimates with this map, by frame index.
        config: The solver's options.
    """
    object_map = state.object_map
    if object_map.pointless or object_map.fixed_keyframes:
        return None
    explained = frozenset(index for index, known in confidence.items() if known >= TRACKED_CONFIDENCE)
    object_map = _remove_unsupported(object_map, explained)
    object_map, camera = refine_globally(object_map, state.camera, config)
    anchors = explained.intersection(view.index for view in object_map.keyframes)
    state = state.with_map(
        object_map,
        camera=camera,
        reinitialization=None,
        inactive_maps=tuple(
            inactive_map_through_lens(other, state.camera, camera) for other in state.inactive_maps
        ),
    )
    return state, ModelCoverage(confidence, anchors)


def end_extension(state: Mapped, found: Collection[int], last: int) -> Mapped:
    """The state for the final refinement; maps of frames that the largest one explains now are given up.

    Args:
        state: After the last gap.
        found: Indices of the frames of gaps in which the object was found.
        last: Index of the last frame of the video.
    """
    kept = tuple(other for other in state.inactive_maps if not _is_explained(other, found))
    given_up = [other for other in state.inactive_maps if _is_explained(other, found)]
    return replace(
        state,
        inactive_maps=kept,
        spans=(*state.spans, *(span for other in given_up for span in other.spans)),
        last_pose=(state.last_pose[0], last),
        previous_pose=None,
        reversal_attempt=(0, 0.0),
    )


def with_more_keyframes(options: OnlineConfig) -> OnlineConfig:
    """The options for a map to which the sides are added that were not explained."""
    return options.model_copy(update={"max_keyframes": int(_ROOM * options.max_keyframes)})


def _remove_unsupported(object_map: ObjectMap, explained: frozenset[int]) -> ObjectMap:
    """The map without keyframes that are guesses, unless half of them are."""
    sound = tuple(
        view
        for place, view in enumerate(object_map.keyframes)
        if place == 0 or view.index in explained or _inliers(object_map, view) >= ENOUGH_POINTS
    )
    if 2 * len(sound) < len(object_map.keyframes) or len(sound) < 2:
        return object_map
    return prune_landmarks(replace(object_map, keyframes=sound), FollowedPoints.none())[0]


def _inliers(object_map: ObjectMap, view: Keyframe) -> int:
    """How many landmarks a keyframe shares with others."""
    return int((object_map.sightings[view.points.landmark] >= 2).sum())


def enter_gap(state: Mapped, gap: Gap, number: int) -> Mapped:
    """The state after a gap's anchor, which is numbered ``number``; the nearest keyframes are the latest ones."""
    anchor = gap.anchor.index
    own = next(view for view in state.object_map.keyframes if view.index == anchor)

    def nearness(view: Keyframe) -> tuple[bool, int]:
        beyond = view.index < anchor if gap.backwards else view.index > anchor
        return not beyond, -abs(view.index - anchor)

    keyframes = tuple(sorted(state.object_map.keyframes, key=nearness))
    object_map = replace(state.object_map, keyframes=keyframes)
    return replace(
        state,
        object_map=object_map,
        last_pose=(own.pose, number),
        previous_pose=None,
        grey=grey(gap.anchor.image),
        tracked_points=own.points,
        lost_frames=0,
        doubtful_frames=0,
        last_candidate=None,
        trajectory=((own.pose, number),),
        motion_references=(),
        inactive_maps=(),
        reversal_attempt=_NEVER_REVERSED,
    )


def leave_gap(state: Mapped, gap: Gap, number: int) -> Mapped:
    """The state after a gap: keyframes have their frames' own indices, and come in order of time."""
    sign = -1 if gap.backwards else 1
    found = {}
    for view in state.object_map.keyframes:  # the later one of a frame takes the place of the earlier one
        index = view.index
        if index >= number:
            index = gap.anchor.index + sign * (index - number)
        found[index] = replace(view, observation=replace(view.observation, index=index))
    keyframes = tuple(found[index] for index in sorted(found))
    object_map = replace(state.object_map, keyframes=keyframes, asked_landmarks=-1)
    object_map = prune_landmarks(object_map, FollowedPoints.none())[0]
    return state.with_map(object_map, trajectory=(), tracked_points=FollowedPoints.none())


def _is_explained(other: InactiveMap, found: Collection[int]) -> bool:
    """Whether the object was found, with the largest map, in at least half of the frames of another map."""
    frames = sum(last - first + 1 for first, last in other.spans)
    inside = sum(any(first <= index <= last for first, last in other.spans) for index in found)
    return 2 * inside >= frames
