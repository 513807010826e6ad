"""Inserts a frame into the map: its points become landmarks, and the map is refined with it."""

from __future__ import annotations

from dataclasses import replace
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.observation import Observer
from tracking3d.estimation.online.features.klt import MOST_FOLLOWED, MOST_POINTS, FollowedPoints, new_corners
from tracking3d.estimation.online.features.sift import detect
from tracking3d.estimation.online.mapping.candidate_landmarks import promote_candidates, with_candidates
from tracking3d.estimation.online.mapping.local_mapping import (
    mask_weight,
    refine_map,
    window_of,
    with_landmarks,
)
from tracking3d.estimation.online.mapping.photometric_adjustment import refine_without_points
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS, PoseCandidate
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, rotation_angle
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.points.view import LANDMARK_WINDOW, GreyWindow, SurfaceView, cut_window, draw_into_window

_FEW_INLIERS = 40  # inliers below which a frame becomes a keyframe for the sake of new points
_MIN_INTERVAL = 3  # frames between two such keyframes
_MIN_OVERLAP = 0.8  # IoU with the mask from which a frame without inliers can be a keyframe
_MAX_KEYFRAMES_WITHOUT_POINTS = 15


def view_frame(
    observer: Observer,
    state: SolverState,
    frame: Frame,
    mask: NDArray[np.bool_] | None,
    pose: Pose,
    followed: FollowedPoints,
) -> Keyframe:
    """A frame seen from a pose, with the mask weight that follows from the points.

    Args:
        observer: How it becomes an observation.
        state: Its map, camera and feature space.
        frame: The frame.
        mask: ``(H, W)`` its initial mask, or None.
        pose: Where the object is about.
        followed: The points that were followed into it.
    """
    object_map, camera = state.object_map, state.camera
    observation = observer.observe(frame, mask, pose, object_map.vertices, camera, state.feature_space)
    on_object = followed.only(~object_map.candidate[followed.landmark])
    weight = 1.0 if observer.config.object.trust_masks else mask_weight(mask, on_object)
    window = cut_around_object(object_map, camera, frame.image, mask, pose)
    return Keyframe(observation, mask, pose, followed, mask_weight=weight, image=window)


def needs_keyframe(object_map: ObjectMap, found: PoseCandidate, config: OnlineConfig) -> bool:
    """Whether a frame shows the map something new, and its pose is reliable."""
    view, fit, inliers = found.view, found.fit, found.evidence.inliers
    if view.mask is None or (inliers < ENOUGH_POINTS and fit.overlap < _MIN_OVERLAP):
        return False
    keyframes = object_map.keyframes
    if inliers < _FEW_INLIERS and view.index >= keyframes[-1].index + _MIN_INTERVAL:
        return True
    angles = [float(rotation_angle(other.pose.quaternion, fit.pose.quaternion)) for other in keyframes]
    return bool(np.degrees(min(angles)) > config.keyframe_rotation)


def insert_points(
    object_map: ObjectMap, camera: Camera, view: Keyframe, image: NDArray[np.uint8]
) -> tuple[ObjectMap, Keyframe]:
    """Add landmarks at a view's keypoints and corners, and candidate landmarks around its mask.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        view: The view with its pose and the points tracked into it.
        image: ``(H, W)`` grey.
    """
    if object_map.pointless:
        return object_map, view
    inside = view.mask if view.mask is not None else object_map.silhouette(view.pose, camera)
    keypoints = detect(image, inside)
    taken = np.concatenate([view.points.pixel, keypoints.pixel])
    corners = new_corners(image, inside, taken, MOST_POINTS)
    object_map, view = with_landmarks(object_map, camera, view, keypoints, corners)
    return (object_map, view) if object_map.fixed_keyframes else with_candidates(object_map, view, image)


def insert_keyframe(
    object_map: ObjectMap, camera: Camera, view: Keyframe, image: NDArray[np.uint8], config: OnlineConfig
) -> tuple[ObjectMap, FollowedPoints]:
    """The map with a view as a new keyframe, refined over the local window, and the points to track from it."""
    object_map, view = insert_points(object_map, camera, view, image)
    drawn, filmed = (
        object_map.keyframes[: object_map.fixed_keyframes],
        (*object_map.keyframes[object_map.fixed_keyframes :], view),
    )
    object_map = replace(object_map, keyframes=(*drawn, *cull_keyframes(filmed, config.max_keyframes)))
    window = window_of(len(object_map.keyframes), config.local_window)
    object_map = refine_local_map(object_map, camera, window, config, bundle_iterations=10, rounds=1)
    followed = object_map.keyframes[-1].points.spread_out(MOST_FOLLOWED, float(view.observation.window.side))
    return prune_landmarks(object_map, followed)


def refine_local_map(
    object_map: ObjectMap,
    camera: Camera,
    positions: list[int],
    config: OnlineConfig,
    *,
    bundle_iterations: int,
    rounds: int,
) -> ObjectMap:
    """Promote or drop candidate landmarks, then refine poses, landmarks and shape; see `refine_map`.

    If the object's shape is fixed, only the newest view's texture is added.
    """
    if object_map.fixed_keyframes:
        return object_map.with_textures([len(object_map.keyframes) - 1])
    if object_map.pointless:
        recent = list(range(len(object_map.keyframes)))[-_MAX_KEYFRAMES_WITHOUT_POINTS:]
        return refine_without_points(
            object_map, sorted({0, *recent}), FitWeights(smoothness=config.smoothness)
        )
    object_map = promote_candidates(object_map, camera, positions)
    return refine_map(
        object_map,
        camera,
        positions,
        weights=FitWeights(smoothness=config.smoothness),
        prior=config.surface_prior,
        bundle_iterations=bundle_iterations,
        rounds=rounds,
        fixed=max(1, _leading_adjusted(object_map, positions)),
    )


def _leading_adjusted(object_map: ObjectMap, positions: list[int]) -> int:
    """How many of the first keyframes at some positions have poses that dense landmarks have adjusted."""
    return len(list(takewhile(lambda position: object_map.keyframes[position].is_adjusted, positions)))


def cull_keyframes(keyframes: tuple[Keyframe, ...], most: int) -> tuple[Keyframe, ...]:
    """At most ``most`` keyframes: the later of the two most similar older ones goes; the first and recent half stay."""
    kept = list(keyframes)
    while len(kept) > most:
        older = kept[: max(len(kept) - most // 2, 2)]
        # Compared with later ones, each would go as it leaves the recent half, and none between would be kept.
        gaps = [
            min(
                float(rotation_angle(older[place].pose.quaternion, other.pose.quaternion))
                for other in older[:place]
            )
            for place in range(1, len(older))
        ]
        kept.pop(1 + int(np.argmin(gaps)))
    return tuple(kept)


def prune_landmarks(object_map: ObjectMap, followed: FollowedPoints) -> tuple[ObjectMap, FollowedPoints]:
    """The map without landmarks that no keyframe shows and no tracked point belongs to; the rest are renumbered."""
    used = np.zeros(len(object_map.landmarks), bool)
    used[followed.landmark] = True
    for view in object_map.keyframes:
        used[view.points.landmark] = True
        used[view.keypoint_landmark[view.keypoint_landmark >= 0]] = True
    number = np.cumsum(used) - 1

    def renamed(points: FollowedPoints) -> FollowedPoints:
        return FollowedPoints(number[points.landmark], points.pixel)

    def relabelled(label: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.where(label >= 0, number[label], -1)

    keyframes = tuple(
        replace(view, points=renamed(view.points), keypoint_landmark=relabelled(view.keypoint_landmark))
        for view in object_map.keyframes
    )
    object_map = replace(
        object_map,
        landmarks=object_map.landmarks[used],
        candidate=object_map.candidate[used],
        keyframes=keyframes,
    )
    return object_map, renamed(followed)


def cut_around_object(
    object_map: ObjectMap,
    camera: Camera,
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    pose: Pose,
) -> GreyWindow | None:
    """The window of a frame in which landmarks are followed; None if there is nothing to be followed.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        image: ``(H, W, 3)`` the frame.
        mask: ``(H, W)`` of the object.
        pose: Where the object is about.
    """
    if mask is None or object_map.pointless or object_map.fixed_keyframes:
        return None
    vertices = object_map.landmark_scene.vertices
    return cut_window(image, mask, camera, pose.matrix().numpy(), vertices, LANDMARK_WINDOW)


def draw_keyframe(object_map: ObjectMap, camera: Camera, view: Keyframe, pose: Pose) -> SurfaceView | None:
    """A keyframe, or a frame that may become one, with the map's surface drawn at a pose; None if it has no window."""
    if view.image is None:
        return None
    scene = object_map.landmark_scene
    return draw_into_window(view.image, camera, pose.matrix().numpy(), scene.vertices, scene.faces)


def draw_keyframes(object_map: ObjectMap, camera: Camera, positions: list[int]) -> LandmarkScene:
    """The map's scene with keyframes drawn at these positions, as far as they have windows."""
    scene = object_map.landmark_scene
    for position in positions:
        if scene.views[position] is None:
            view = object_map.keyframes[position]
            scene.views[position] = draw_keyframe(object_map, camera, view, view.pose)
    return scene
