"""Refines all keyframes together, and the focal length if it is not given; kept only if the rendering cost falls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.online.mapping.focal_length import (
    lens_change,
    map_through_lens,
    solve_lens,
    state_through_lens,
)
from tracking3d.estimation.online.mapping.keyframe_insertion import draw_keyframes, refine_local_map
from tracking3d.estimation.online.mapping.local_mapping import fit_shape, surface_places, tracks_of, window_of
from tracking3d.estimation.online.mapping.photometric_adjustment import fit_jointly
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose, render_cost
from tracking3d.estimation.online.optimization.shape_basis import ShapeBasis
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.estimation.shape import flatten
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_from_arrays
from tracking3d.points.landmark_adjustment import LandmarkScene, is_supported, refine_through
from tracking3d.points.robust_bundle import intersect
from tracking3d.runtime.background_attempt import BackgroundAttempt

_PASSES = 3
_VIEWS_WITHOUT_POINTS, _EVALUATIONS = 16, 12  # without points (chosen; 15 evaluations more: no gain)
_FOCAL_LENGTH_PENALTY = 0.01
"""Cost by which twice or half the focal length must explain the keyframes better than the current one."""


def refine_globally(object_map: ObjectMap, camera: Camera, config: OnlineConfig) -> tuple[ObjectMap, Camera]:
    """The map and the camera with the least rendering cost: unchanged, refined, or refined with the focal length.

    Reprojection errors fall with every additional unknown; the rendering cost falls only if the map gets better.
    Without this check a refinement can end worse than it began. A map with a fixed shape stays unchanged.

    Args:
        object_map: The map.
        camera: The camera of the full frame; if its focal length is assumed, another one is tried.
        config: The solver's options.
    """
    if object_map.fixed_keyframes:
        return object_map, camera
    tried = [(keyframe_cost(object_map), object_map, camera), _refine_with_lens(object_map, camera, config)]
    if camera.assumed:
        with_lens, solved = solve_lens(object_map, camera)
        if solved != camera:
            cost, better, _ = _refine_with_lens(with_lens, solved, config)
            tried.append((cost + _FOCAL_LENGTH_PENALTY * lens_change(solved.fy / camera.fy), better, solved))
    _, object_map, camera = min(tried, key=lambda one: one[0])
    return object_map, camera


def refit_without_points(object_map: ObjectMap, weights: FitWeights) -> ObjectMap:
    """A map without points fitted to keyframes from all of the video, its surface begun as it is or as the prototype.

    Local mapping fits the last keyframes, and a surface keeps what poses that were wrong have made of it.

    Args:
        object_map: The map; at most `_VIEWS_WITHOUT_POINTS` of its keyframes stay.
        weights: The weights of the shape's terms.
    """
    if len(object_map.keyframes) < 2:
        return object_map
    count = min(_VIEWS_WITHOUT_POINTS, len(object_map.keyframes))
    places = np.linspace(0, len(object_map.keyframes) - 1, count).round().astype(int)
    spread = replace(object_map, keyframes=tuple(object_map.keyframes[place] for place in places))
    modes = ShapeBasis.of(object_map.shape)
    starts = [replace(spread, vertices=vertices) for vertices in (spread.vertices, object_map.shape.rest)]
    fits = [fit_jointly(start, modes, weights, _EVALUATIONS) for start in starts]
    fitted = min(fits, key=lambda one: one[1])[0]
    vertices = flatten(fitted.vertices) if fitted.shape.flat else fitted.vertices
    return replace(fitted, vertices=vertices).with_textures()


def keyframe_cost(object_map: ObjectMap) -> float:
    """The mean cost of the keyframes at their poses: pixels, outlines, and uncovered parts of the masks."""
    costs = [
        render_cost(fit, PoseWeights(), view.mask_weight)
        for fit, view in zip(fit_keyframes(object_map), object_map.keyframes, strict=True)
    ]
    return float(np.mean(costs)) if costs else 0.0


def fit_keyframes(object_map: ObjectMap) -> list[PoseFit]:
    """The losses of the keyframes at their poses, which stay."""
    surface = object_map.surface()
    return [
        refine_pose(surface, view.observation, view.pose, iterations=(0,)) for view in object_map.keyframes
    ]


def _refine_with_lens(
    object_map: ObjectMap, camera: Camera, config: OnlineConfig
) -> tuple[float, ObjectMap, Camera]:
    everything = list(range(len(object_map.keyframes)))
    for _ in range(_PASSES):
        object_map = refine_local_map(object_map, camera, everything, config, bundle_iterations=15, rounds=2)
    return keyframe_cost(object_map), object_map, camera


# The map refined by landmarks that are followed densely over its keyframes, with the focal length if it is not given.
#
# Local mapping knows keypoints and corners that were tracked from frame to frame, and a surface that is a few percent
# off. Poses drift with both. Here corners are followed from keyframe to keyframe through the surface and bundled with
# the poses, as the final refinement does it (`tracking3d.points.landmark_adjustment`). Local mapping then keeps the
# poses of these keyframes.

_ROUNDS = 2
"""Each leaves some tenths of an error, and so do those at the next keyframe."""
_LEAST_KEYFRAMES = 4
_NEW_SHARE = 0.1
"""Share of the keyframes that are new, from which on the map is refined again: a refinement takes time for every
keyframe, so that a frame of a long video costs as much as one of a short one."""
_SHAPE_ROUNDS = 2
"""Of the surface fit afterwards: dense landmarks leave the rim of the surface where they found it."""
_TRACK_DEVIATION = 1.0  # pixels, of points that were tracked from frame to frame
_HELD = 0.05  # deviation of the map's landmarks from the surface, in radii


def refine_by_landmarks(state: Mapped, config: OnlineConfig) -> Mapped:
    """The state with map, camera and last pose refined by dense landmarks; unchanged if these say too little.

    Nothing happens before enough keyframes are new.

    Args:
        state: The state after a keyframe was inserted.
        config: The solver's options.
    """
    object_map = state.object_map
    if not _is_due(object_map):
        return state
    newest = object_map.keyframes[-1].index
    object_map = replace(object_map, asked_landmarks=newest)
    refined = _refine_map(object_map, state.camera, config)
    if refined is None:
        return replace(state, object_map=object_map)
    object_map, camera = refined
    state = state_through_lens(state, camera)
    if state.last_pose[1] == newest:
        state = replace(state, last_pose=(object_map.keyframes[-1].pose, newest))
    return state.with_map(object_map)


def refine_in_background(state: Mapped, config: OnlineConfig) -> Mapped:
    """The state whose map is being refined by dense landmarks in another thread, if that is due."""
    object_map = state.object_map
    if not _is_due(object_map):
        return state
    snapshot = replace(state, object_map=replace(object_map))  # with drawings of its own
    attempt = BackgroundAttempt[Mapped, None, None](
        lambda: (refine_by_landmarks(snapshot, config), ()), lambda refined, _: (refined, [])
    )
    return replace(state, refinement=(object_map, attempt))


def adopt_refinement(state: Mapped, wait: float | None = 0.0) -> Mapped:
    """The state with the map that another thread has refined, once that is done; poses move with its last keyframe.

    It is dropped if the state has another map by now, or if the other thread has failed.

    Args:
        state: The state.
        wait: Most seconds to wait for it; no limit if None.
    """
    if state.refinement is None or not state.refinement[1].is_done(wait):
        return state
    (before, attempt), state = state.refinement, replace(state, refinement=None)
    if attempt.has_failed or state.object_map is not before:
        return state
    refined: Mapped = attempt.outcome().state
    state = state_through_lens(state, refined.camera)
    from_old = np.linalg.inv(state.object_map.keyframes[-1].pose.matrix().numpy().astype(np.float64))
    to_new = refined.object_map.keyframes[-1].pose.matrix().numpy()

    def move(pose: Pose) -> Pose:
        T = pose.matrix().numpy() @ from_old @ to_new
        return pose_from_arrays(T[:3, :3], T[:3, 3], pose.translation)

    return state.moved(refined.object_map, move, motion_references=state.motion_references)


def _is_due(object_map: ObjectMap) -> bool:
    """Whether a map can be refined, and enough keyframes are new since it was."""
    if object_map.pointless or object_map.fixed_keyframes:
        return False
    count = len(object_map.keyframes)
    new = sum(view.index > object_map.asked_landmarks for view in object_map.keyframes)
    return count >= _LEAST_KEYFRAMES and new >= max(1.0, _NEW_SHARE * count)


def _refine_map(
    object_map: ObjectMap, camera: Camera, config: OnlineConfig
) -> tuple[ObjectMap, Camera] | None:
    """The refined map in the object frame of its first keyframe, and the camera; None if landmarks say too little."""
    scene = draw_keyframes(object_map, camera, list(range(len(object_map.keyframes))))
    if scene.views[0] is None or sum(view is not None for view in scene.views) < _LEAST_KEYFRAMES:
        return None
    scene = refine_through(scene, _ROUNDS, camera)
    if not is_supported(scene):
        return None
    if scene.focal_factor != 1:
        solved = camera.with_solved_focal(scene.focal_factor)
        object_map, camera = map_through_lens(object_map, camera, solved), solved
    object_map = _triangulate(_take_over(object_map, scene, camera), camera)
    positions = window_of(len(object_map.keyframes), config.local_window)
    object_map = fit_shape(object_map, positions, FitWeights(smoothness=config.smoothness), _SHAPE_ROUNDS)
    return object_map.with_textures(), camera


def _take_over(object_map: ObjectMap, scene: LandmarkScene, camera: Camera) -> ObjectMap:
    """The map with a scene's surface and poses, and the first keyframe's pose; if the lens may move, its rotation."""
    first = scene.views[0]
    assert first is not None
    T_map_scene = np.linalg.inv(object_map.keyframes[0].pose.matrix().numpy()) @ first.T_cam_obj
    if camera.assumed:  # the origin stays in the object: another lens moves both alike
        centre = T_map_scene[:3, :3] @ scene.vertices.mean(0)
        T_map_scene[:3, 3] = object_map.vertices.cpu().numpy().mean(0) - centre
    T_scene_map = np.linalg.inv(T_map_scene)
    keyframes = list[Keyframe]()
    for view, drawn in zip(object_map.keyframes, scene.views, strict=True):
        if drawn is not None:
            T = drawn.T_cam_obj @ T_scene_map
            pose = pose_from_arrays(T[:3, :3], T[:3, 3], object_map.vertices)
            view = replace(view, pose=pose, is_adjusted=True)
        keyframes.append(view)
    vertices = torch.from_numpy(_transform(T_map_scene, scene.vertices)).to(object_map.vertices)
    landmarks = _transform(T_map_scene, object_map.landmarks)
    return replace(object_map, vertices=vertices, landmarks=landmarks, keyframes=tuple(keyframes))


def _triangulate(object_map: ObjectMap, camera: Camera) -> ObjectMap:
    """The map with its landmarks where its poses and its surface put them."""
    views = list(object_map.keyframes)
    names = np.unique(np.concatenate([view.points.landmark for view in views]))
    names = names[~object_map.candidate[names]]
    places = surface_places(object_map, camera, views, names)
    on_surface = np.isfinite(places).all(1)
    names, places = names[on_surface], places[on_surface]
    if not len(names):
        return object_map
    tracks = tracks_of(views, names)
    landmarks = object_map.landmarks.copy()
    landmarks[names], _ = intersect(
        places,
        np.tile([camera.fx, camera.fy, camera.cx, camera.cy], (len(views), 1)),
        np.stack([view.pose.matrix().numpy() for view in views]),
        tracks.pixels,
        np.where(tracks.visible, _TRACK_DEVIATION, np.inf),
        _HELD * object_map.radius,
    )
    return replace(object_map, landmarks=landmarks)


def _transform(T: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])
