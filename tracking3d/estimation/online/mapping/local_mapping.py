"""The map: landmarks on the surface, keyframes, and their joint refinement."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints, match
from tracking3d.estimation.online.optimization.shape_fit import (
    FitWeights,
    Landmarks,
    ShapeKeyframes,
    fit_surface,
)
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.shape import flatten
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays
from tracking3d.points.bundle_adjustment.adjustment import Structure, Tracks, adjust
from tracking3d.rendering import project as project_vertices
from tracking3d.rendering.visibility import nearest_depth

FloatArray = NDArray[np.float64]
_SAME_PLACE = 1.5  # pixels within which a keypoint is the same as a tracked point
_MIN_INLIERS = 12
_MIN_ADJUSTED = 8
_MAX_ADJUSTED = 1500
_UPSAMPLING = 4  # supersampling for a surface that is fixed
_MATCH_RADIUS = 12.0  # pixels around its projection within which a landmark is matched


def lift_pixels(
    object_map: ObjectMap, camera: Camera, view: Keyframe, pixel: NDArray[np.float32]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Surface points ``(N, 3)`` at pixels ``(N, 2)`` of the full frame, and which pixels meet the surface.

    The depth is that of the window's nearest rendered pixel. A fixed surface is rendered at a higher resolution, since
    no bundle adjustment corrects its points.
    """
    observation, finer = view.observation, _UPSAMPLING if object_map.fixed_keyframes else 1
    size, K = finer * observation.window.size, observation.K
    if finer > 1:
        K = K * K.new_tensor([[finer], [finer], [1.0]])
        K[:2, 2] += (finer - 1) / 2  # pixel centres stay at integers
    screen, depth = project_vertices(
        object_map.vertices, view.pose.R[None], view.pose.translation[None], K[None]
    )
    plane = nearest_depth(screen[0], depth[0], object_map.shape.faces, (size, size), object_map.renderer)
    drawn = plane.cpu().numpy()
    in_window = (to_window(view, pixel) + 0.5) * finer - 0.5
    column, row = np.clip(np.rint(in_window), 0, size - 1).astype(int).T
    inside = (np.abs(in_window - (size - 1) / 2) <= size / 2).all(1)
    # The deepest neighbour is the background; the nearest would cut corners off the outline.
    z = drawn[row, column]
    met = inside & np.isfinite(z)
    z = np.where(met, z, 1.0)
    ray = (pixel - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    x_cam = np.concatenate([ray, np.ones((len(ray), 1))], 1) * z[:, None]
    R, t = pose_arrays(view.pose)
    return (x_cam - t) @ R, met


def mask_weight(mask: NDArray[np.bool_] | None, points: FollowedPoints) -> float:
    """How far a mask is trusted, by the share of inliers that lie inside it."""
    if mask is None or len(points) < _MIN_INLIERS:
        return 1.0
    reach = max(round(0.02 * float(np.sqrt(mask.sum()))), 1)
    wide = cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    x, y = np.rint(points.pixel).astype(int).T
    inside = wide[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)].mean()
    return float(np.clip((inside - 0.75) / 0.2, 0.02, 1.0))


def is_well_inside(
    mask: NDArray[np.bool_] | None, silhouette: NDArray[np.bool_], pixel: NDArray[np.float32], margin: float
) -> NDArray[np.bool_]:
    """``(N,)`` whether pixels lie in the mask or the silhouette, and at least ``margin`` from the outlines of both.

    Points on an occluding contour slide over the surface as the object rotates.
    """
    covered = silhouette if mask is None else mask | silhouette
    depth = cv2.distanceTransform(covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    x, y = np.rint(pixel).astype(int).T
    return np.asarray(depth[y.clip(0, depth.shape[0] - 1), x.clip(0, depth.shape[1] - 1)] > margin)


def to_window(view: Keyframe, pixel: NDArray[np.float32]) -> FloatArray:
    """``(N, 2)`` pixels of the full frame in the coordinates of the view's window."""
    window = view.observation.window
    return np.asarray((pixel.astype(np.float64) + 0.5 - [window.left, window.top]) * window.scale - 0.5)


def project_points(points: FloatArray, pose: Pose, camera: Camera) -> FloatArray:
    """``(N, 2)`` pixels of the full frame of points in object coordinates."""
    R, t = pose_arrays(pose)
    x_cam = points @ R.T + t
    return x_cam[:, :2] / np.maximum(x_cam[:, 2:], 1e-6) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def with_landmarks(
    object_map: ObjectMap, camera: Camera, view: Keyframe, keypoints: Keypoints, corners: NDArray[np.float32]
) -> tuple[ObjectMap, Keyframe]:
    """Assign every keypoint and corner of a view to a landmark: a tracked, a matched or a new one.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        view: The view with the points tracked into it.
        keypoints: The view's keypoints.
        corners: ``(N, 2)`` further pixels for new landmarks.
    """
    label = np.full(len(keypoints), -1, np.int64)
    followed = view.points
    if len(followed) and len(keypoints):
        gap = np.linalg.norm(keypoints.pixel[:, None] - followed.pixel[None], axis=2)
        nearest = gap.argmin(1)
        label = np.where(gap[np.arange(len(gap)), nearest] < _SAME_PLACE, followed.landmark[nearest], -1)
    taken = set(followed.landmark.tolist())
    limit = _MATCH_RADIUS * max(1.0, view.observation.window.side / 200)
    for other in nearest_views(object_map.keyframes, view.pose, 4):
        pairs = match(keypoints, other.keypoints)
        pairs = pairs[label[pairs[:, 0]] < 0]
        landmark = other.keypoint_landmark[pairs[:, 1]]
        known_here = landmark >= 0
        pairs, landmark = pairs[known_here], landmark[known_here]
        place = project_points(object_map.landmarks[landmark], view.pose, camera)
        near = np.linalg.norm(place - keypoints.pixel[pairs[:, 0]], axis=1) < limit
        for position, name in zip(pairs[near, 0], landmark[near], strict=True):
            if name not in taken:
                label[position] = name
                taken.add(int(name))
    fresh = np.flatnonzero(label < 0)
    # Two keypoints at one pixel are one landmark.
    pixels = np.concatenate([keypoints.pixel[fresh], corners])
    points, met = lift_pixels(object_map, camera, view, pixels)
    names = np.full(len(pixels), -1, np.int64)
    names[met] = len(object_map.landmarks) + np.arange(met.sum())
    landmarks = np.concatenate([object_map.landmarks, points[met]])
    label[fresh] = names[: len(fresh)]
    found = label >= 0
    own, first = np.unique(label[found], return_index=True)
    again = ~np.isin(own, followed.landmark)
    added = FollowedPoints(own[again], keypoints.pixel[found][first][again])
    corner_names = names[len(fresh) :]
    usable = corner_names >= 0
    points_now = FollowedPoints(
        np.concatenate([followed.landmark, added.landmark, corner_names[usable]]),
        np.concatenate([followed.pixel, added.pixel, corners[usable]]),
    )
    named = replace(view, points=points_now, keypoints=keypoints, keypoint_landmark=label)
    candidate = np.concatenate(
        [object_map.candidate, np.zeros(len(landmarks) - len(object_map.landmarks), bool)]
    )
    return replace(object_map, landmarks=landmarks, candidate=candidate), named


def nearest_views(keyframes: tuple[Keyframe, ...], pose: Pose, most: int) -> list[Keyframe]:
    """The keyframes whose viewing directions of the object are nearest to a pose's."""
    if not keyframes:
        return []
    angles = [viewing_angle(view.pose, pose) for view in keyframes]
    return [keyframes[i] for i in np.argsort(angles, kind="stable")[:most]]


def viewing_angle(a: Pose, b: Pose) -> float:
    """Degrees between two poses' viewing directions of the object."""
    return float(np.degrees(np.arccos(np.clip(a.viewing_direction @ b.viewing_direction, -1, 1))))


def window_of(count: int, most: int) -> list[int]:
    """Positions of the keyframes refined together: the first, half recent ones, half spread over the older ones."""
    if count <= most:
        return list(range(count))
    recent = list(range(count - most // 2, count))
    older = np.linspace(0, count - most // 2 - 1, most - len(recent)).round().astype(int).tolist()
    return sorted({*older, *recent})


def refine_map(
    object_map: ObjectMap,
    camera: Camera,
    positions: list[int],
    *,
    weights: FitWeights,
    prior: float,
    scale: float = 1.0,
    bundle_iterations: int = 10,
    rounds: int = 1,
    fixed: int = 1,
) -> ObjectMap:
    """Refine poses and landmarks by bundle adjustment, then the shape by outlines and landmarks, then the texture.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        positions: Positions of the keyframes to refine; the poses of the first ``fixed`` are held.
        weights: The weights of the shape's terms.
        prior: Cost of a landmark at distance 1 from the surface, see
            `tracking3d.points.bundle_adjustment.adjustment.adjust`.
        scale: Scale in pixels of the robust loss.
        bundle_iterations: Iterations of the bundle adjustment.
        rounds: Rounds of the shape fit.
        fixed: How many of the first keyframes keep their poses.
    """
    object_map = _adjust_bundle(object_map, camera, positions, prior, scale, bundle_iterations, fixed)
    object_map = fit_shape(object_map, positions, weights, rounds)
    return object_map.with_textures(positions)


def _adjust_bundle(
    object_map: ObjectMap,
    camera: Camera,
    positions: list[int],
    prior: float,
    scale: float,
    iterations: int,
    fixed: int,
) -> ObjectMap:
    views = [object_map.keyframes[position] for position in positions]
    names = shared_landmarks(object_map, views)
    if len(names) < _MIN_ADJUSTED or len(views) < 2:
        return object_map
    tracks, start = tracks_of(views, names), structure_of(object_map, views, names)
    places = surface_places(object_map, camera, views, names)
    found = adjust(
        tracks, camera.K, start, fixed=fixed, scale=scale, iterations=iterations,
        point_prior=places, point_prior_weight=prior,
    )  # fmt: skip
    landmarks = object_map.landmarks.copy()
    sound = np.isfinite(found.points).all(1)
    landmarks[names[sound]] = found.points[sound]
    keyframes = list(object_map.keyframes)
    for n, position in enumerate(positions):
        keyframes[position] = replace(
            keyframes[position], pose=pose_from_arrays(found.R[n], found.t[n], object_map.vertices)
        )
        residual = found.residual[n]
        bad = names[np.nan_to_num(residual, nan=0.0) > 4 * scale]
        if len(bad):
            view = keyframes[position]
            keyframes[position] = replace(view, points=view.points.only(~np.isin(view.points.landmark, bad)))
    # Landmarks seen once move with the surface.
    return replace(object_map, landmarks=landmarks, keyframes=tuple(keyframes))


def shared_landmarks(object_map: ObjectMap, views: list[Keyframe]) -> NDArray[np.int64]:
    """Landmarks that at least two of the views show, ascending; those that most views show constrain the poses."""
    names, counts = np.unique(np.concatenate([view.points.landmark for view in views]), return_counts=True)
    usable = (counts >= 2) & ~object_map.candidate[names]
    names, counts = names[usable], counts[usable]
    return np.sort(names[np.argsort(-counts, kind="stable")[:_MAX_ADJUSTED]])


def structure_of(object_map: ObjectMap, views: list[Keyframe], names: NDArray[np.int64]) -> Structure:
    """The views' current poses and the given landmarks' current positions."""
    poses = [pose_arrays(view.pose) for view in views]
    return Structure(
        np.array([R for R, _ in poses]), np.array([t for _, t in poses]), object_map.landmarks[names]
    )


def surface_places(
    object_map: ObjectMap, camera: Camera, views: list[Keyframe], names: NDArray[np.int64]
) -> FloatArray:
    """``(N, 3)`` surface points at the pixel of each landmark's first view; nan if there is none."""
    places = np.full((len(names), 3), np.nan)
    for view in views:
        open_ = np.isnan(places[:, 0]) & np.isin(names, view.points.landmark)
        if not open_.any():
            continue
        order = {int(name): i for i, name in enumerate(view.points.landmark)}
        rows = np.array([order[int(name)] for name in names[open_]])
        points, met = lift_pixels(object_map, camera, view, view.points.pixel[rows])
        places[np.flatnonzero(open_)[met]] = points[met]
    return places


def tracks_of(views: list[Keyframe], names: NDArray[np.int64]) -> Tracks:
    """Pixels of the given landmarks (ascending) in the views."""
    pixels = np.full((len(views), len(names), 2), np.nan)
    for row, view in enumerate(views):
        place = np.searchsorted(names, view.points.landmark)
        inside = place < len(names)
        inside[inside] &= names[place[inside]] == view.points.landmark[inside]
        pixels[row, place[inside]] = view.points.pixel[inside]
    return Tracks(pixels, np.isfinite(pixels[..., 0]))


def fit_shape(object_map: ObjectMap, positions: list[int], weights: FitWeights, rounds: int) -> ObjectMap:
    """Refit the vertices to the outlines of the keyframes at these positions and to the landmarks they show."""
    if not rounds:
        return object_map
    views = [object_map.keyframes[position] for position in positions]
    observations = [view.observation for view in views]
    poses = Pose.stack([view.pose for view in views])
    seen = ShapeKeyframes(
        poses.R,
        poses.translation,
        torch.stack([o.K for o in observations]),
        torch.stack([o.outline_distance for o in observations]),
        torch.tensor([v.mask_weight * v.observation.has_mask for v in views]).to(object_map.vertices),
    )
    names, number = np.unique(np.concatenate([v.points.landmark for v in views]), return_counts=True)
    names = names[
        (number >= 2) & ~object_map.candidate[names] & np.isfinite(object_map.landmarks[names]).all(1)
    ]
    which = np.full(len(object_map.landmarks), -1)
    for n, view in enumerate(views):
        which[view.points.landmark] = n
    landmarks = Landmarks(
        torch.from_numpy(object_map.landmarks[names]).to(object_map.vertices), torch.from_numpy(which[names])
    )
    vertices = fit_surface(
        object_map.vertices, object_map.shape.rest, object_map.shape.faces, object_map.shape.face_uvs,
        object_map.shape.laplacian, seen, landmarks, weights, rounds, object_map.renderer,
    )  # fmt: skip
    return replace(object_map, vertices=flatten(vertices) if object_map.shape.flat else vertices)
