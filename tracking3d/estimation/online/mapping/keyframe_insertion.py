"""Inserts a frame into the map: its points become landmarks, and the map is refined with it."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import OnlineConfig
from tracking3d.estimation.observation import Observer
from tracking3d.estimation.online.features.klt import MOST_FOLLOWED, MOST_POINTS, FollowedPoints, new_corners
from tracking3d.estimation.online.features.sift import SIFT, Detector, detect_turned
from tracking3d.estimation.online.mapping.local_mapping import (
    mask_weight,
    refine_map,
    tracks_of,
    viewing_angle,
    window_of,
    with_landmarks,
)
from tracking3d.estimation.online.mapping.photometric_adjustment import refine_without_points
from tracking3d.estimation.online.optimization.shape_fit import FitWeights
from tracking3d.estimation.online.state.confidence import ENOUGH_POINTS, PoseCandidate
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import SolverState
from tracking3d.frames import Frame
from tracking3d.geometry.camera import Camera, pixel_distance
from tracking3d.geometry.pose import Pose, pose_arrays, rotation_angle
from tracking3d.points.bundle_adjustment.adjustment import Structure, adjust
from tracking3d.points.bundle_adjustment.reprojection import project_camera_points, transform_to_camera
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.points.view import LANDMARK_WINDOW, cut_window, draw_into_window
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import FrameCrop

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
    poses = Pose.stack([other.pose for other in keyframes])
    return (
        math.degrees(rotation_angle(poses.quaternion, fit.pose.quaternion).min()) > config.keyframe_rotation
    )


def insert_points(
    object_map: ObjectMap, camera: Camera, view: Keyframe, image: NDArray[np.uint8], detector: Detector = SIFT
) -> tuple[ObjectMap, Keyframe]:
    """Add landmarks at a view's keypoints and corners, and candidate landmarks around its mask.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        view: The view with its pose and the points tracked into it.
        image: ``(H, W)`` grey.
        detector: What finds keypoints.
    """
    if object_map.pointless:
        return object_map, view
    inside = view.mask if view.mask is not None else object_map.silhouette(view.pose, camera)
    (keypoints,) = detect_turned(image, inside, detector, pose_arrays(view.pose)[0])
    taken = np.concatenate([view.points.pixel, keypoints.pixel])
    corners = new_corners(image, inside, taken, MOST_POINTS)
    object_map, view = with_landmarks(object_map, camera, view, keypoints, corners)
    return (object_map, view) if object_map.fixed_keyframes else with_candidates(object_map, view, image)


def insert_keyframe(
    object_map: ObjectMap,
    camera: Camera,
    view: Keyframe,
    image: NDArray[np.uint8],
    config: OnlineConfig,
    detector: Detector = SIFT,
) -> tuple[ObjectMap, FollowedPoints]:
    """The map with a view as a new keyframe, refined over the local window, and the points to track from it."""
    object_map, view = insert_points(object_map, camera, view, image, detector)
    drawn = object_map.keyframes[: object_map.fixed_keyframes]
    filmed = (*object_map.keyframes[object_map.fixed_keyframes :], view)
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
) -> FrameCrop | None:
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


def draw_keyframe(object_map: ObjectMap, camera: Camera, view: Keyframe, pose: Pose) -> Drawn | None:
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


# Candidate landmarks: points outside the mask that move with the object, and so show where the mask is too small.
#
# Corners around the mask are tracked like the object's own. Once a few keyframes show one, it is triangulated with
# their poses. A point of the object fits them and has moved in the image; one of the background fits only while nothing
# moves. If the object is still and the camera moves, everything fits: then no candidate becomes part of the object, but
# the candidates constrain the pose.

MOST_CANDIDATES = 100
_BAND_WIDTH = 0.25  # width of the band around the mask, relative to the root of its area
_VIEWS = 3
# Mean residual in pixels at an object size of 200 pixels
_MAX_INLIER_RESIDUAL, _MIN_OUTLIER_RESIDUAL = 1.0, 2.5
_MIN_MOTION = 6.0  # such pixels
_MIN_ROTATION = 12.0
"""Degrees by which an object that rested at first must have been seen to turn while a candidate was tracked: a thing on
a table turns less, if a hand touches it or the camera moves in a hand, and then the table fits as well as it does."""
_MAX_STATIC_MOTION = 0.3  # share of the motion that the object would have caused
_SECTORS = 8  # directions into which the surroundings are divided
_STATIC_SHARE = 0.6  # share of a sector's candidates, and of the sectors, that fit if the scene is static
# Fewest sectors that can be tested, and fewest candidates of such a sector
_MIN_SECTORS, _MIN_CANDIDATES = 5, 3


def surroundings(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """``(H, W)`` the band around a mask."""
    reach = max(round(_BAND_WIDTH * float(np.sqrt(mask.sum()))), 3)
    return (pixel_distance(mask) <= reach) & ~mask


def with_candidates(
    object_map: ObjectMap, view: Keyframe, image: NDArray[np.uint8]
) -> tuple[ObjectMap, Keyframe]:
    """Add corners around a view's mask as candidate landmarks."""
    if view.mask is None:
        return object_map, view
    there = int(object_map.candidate[view.points.landmark].sum())
    corners = new_corners(image, surroundings(view.mask), view.points.pixel, MOST_CANDIDATES - there)
    names = len(object_map.landmarks) + np.arange(len(corners))
    points = FollowedPoints(
        np.concatenate([view.points.landmark, names]), np.concatenate([view.points.pixel, corners])
    )
    object_map = replace(
        object_map,
        landmarks=np.concatenate([object_map.landmarks, np.full((len(corners), 3), np.nan)]),
        candidate=np.concatenate([object_map.candidate, np.ones(len(corners), bool)]),
    )
    return object_map, replace(view, points=points)


def promote_candidates(object_map: ObjectMap, camera: Camera, positions: list[int]) -> ObjectMap:
    """Promote candidates to landmarks, or drop them, if the keyframes at ``positions`` show which they are."""
    views = [object_map.keyframes[position] for position in positions]
    names, counts = np.unique(np.concatenate([view.points.landmark for view in views]), return_counts=True)
    names = names[(counts >= 2) & object_map.candidate[names]]
    if not len(names):
        return object_map
    tracks = tracks_of(views, names)
    poses = [pose_arrays(view.pose) for view in views]
    R, t = np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])
    first = tracks.visible.argmax(0)
    pixel = tracks.pixels[first, np.arange(len(names))]
    ray = (pixel - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    x_cam = np.concatenate([ray, np.ones((len(ray), 1))], 1) * t[first, 2:]
    start = Structure(R, t, np.einsum("nji,nj->ni", R[first], x_cam - t[first]))
    scale = max(1.0, views[-1].observation.window.side / 200)
    found = adjust(tracks, camera.K, start, fixed=len(views), scale=scale, iterations=8)
    known_residual = np.isfinite(found.residual)
    total = np.where(known_residual, found.residual, 0.0).sum(0)
    # A point that ends up behind every camera has no residual, and fits nothing.
    residual = np.divide(
        total / scale, known_residual.sum(0), out=np.full(len(names), np.inf), where=known_residual.any(0)
    )
    motion = np.nanmax(np.linalg.norm(tracks.pixels - pixel, axis=2), 0) / scale
    # A point that stays although the object would have moved it is not on the object.
    carried = np.linalg.norm(
        project_camera_points(transform_to_camera(R, t, start.points), camera.K) - pixel, axis=2
    )
    carried = np.nanmax(np.where(tracks.visible, carried, np.nan), 0) / scale
    stays = (carried > _MIN_MOTION) & (motion < _MAX_STATIC_MOTION * carried)
    near = (
        np.linalg.norm(found.points - object_map.vertices.mean(0).cpu().numpy(), axis=1)
        < 1.6 * object_map.radius
    )
    enough = tracks.visible.sum(0) >= _VIEWS
    fits = enough & (residual < _MAX_INLIER_RESIDUAL) & (motion > _MIN_MOTION) & near & ~stays
    accepted = fits
    if object_map.started_at_rest:
        accepted = fits & (_rotation_seen(views, tracks.visible, first) > _MIN_ROTATION)
    rejected = stays | (enough & ((residual > _MIN_OUTLIER_RESIDUAL) | ~near) & (motion > _MIN_MOTION))
    rejected |= (tracks.visible.sum(0) >= 2 * _VIEWS) & ~fits
    told = enough & (motion > _MIN_MOTION)
    beside = object_map.candidates_around + _by_sector(
        views, first, pixel, told, residual < _MAX_INLIER_RESIDUAL
    )
    around = np.zeros_like(accepted)
    if is_static_scene(beside):
        # They constrain the pose as well as the object's own points do, but not its shape or mask.
        around, accepted = told & (residual < _MAX_INLIER_RESIDUAL), np.zeros_like(accepted)
        rejected = (told | (tracks.visible.sum(0) >= 2 * _VIEWS)) & ~around
    landmarks, candidate = object_map.landmarks.copy(), object_map.candidate.copy()
    placed = accepted | around
    landmarks[names[placed]] = found.points[placed]
    candidate[names[accepted]] = False
    dropped = names[rejected & ~accepted]
    keyframes = tuple(
        replace(view, points=view.points.only(~np.isin(view.points.landmark, dropped)))
        for view in object_map.keyframes
    )
    return replace(
        object_map, landmarks=landmarks, candidate=candidate, keyframes=keyframes, candidates_around=beside
    )


def _rotation_seen(
    views: list[Keyframe], visible: NDArray[np.bool_], first: NDArray[np.intp]
) -> NDArray[np.float64]:
    """``(N,)`` degrees by which each candidate has been seen to turn, since the first view that shows it."""
    angles = np.array([[viewing_angle(a.pose, b.pose) for b in views] for a in views])
    seen: NDArray[np.float64] = np.where(visible.T, angles[first], 0.0).max(1)
    return seen


def is_static_scene(beside: NDArray[np.int64]) -> bool:
    """Whether everything around the object moves with it: then the object is still, and the camera moves.

    A mask that is too small has points of the object outside it on some sides only, as has one next to a hand.

    Args:
        beside: ``(S, 2)`` candidates in each sector around the object: those that could be tested, and those that fit.
    """
    told, fit = beside.T
    tells = told >= _MIN_CANDIDATES
    if tells.sum() < _MIN_SECTORS:
        return False
    return bool((fit[tells] > _STATIC_SHARE * told[tells]).mean() > _STATIC_SHARE)


def _by_sector(
    views: list[Keyframe],
    first: NDArray[np.intp],
    pixel: NDArray[np.float64],
    told: NDArray[np.bool_],
    fits: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """``(S, 2)`` candidates in each direction from the mask's centre: those tested, and those that fit."""
    counts = np.zeros((_SECTORS, 2), np.int64)
    for number in np.unique(first[told]):
        mask = views[number].mask
        if mask is None or not mask.any():
            continue
        chosen = told & (first == number)
        x, y = (pixel[chosen] - np.argwhere(mask)[:, ::-1].mean(0)).T
        sector = ((np.arctan2(y, x) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
        np.add.at(counts, (sector, 0), 1)
        np.add.at(counts, (sector[fits[chosen]], 1), 1)
    return counts
