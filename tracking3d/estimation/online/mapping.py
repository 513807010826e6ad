"""The map: landmarks on the surface, keyframes, and their joint refinement."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.bundle_adjustment.adjustment import Structure, Tracks, adjust
from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.keypoints import Keypoints, match
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.surface_fit import FitWeights, Landmarks, ShapeKeyframes, fit_surface
from tracking3d.estimation.shape import flatten
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix
from tracking3d.rendering import project as project_vertices
from tracking3d.rendering import rasterize

FloatArray = NDArray[np.float64]
_SAME_PLACE = 1.5  # pixels within which a keypoint is a point that is followed
_FEWEST_WITNESSES = 12
_FEWEST_BUNDLED = 8
_MOST_BUNDLED = 1500
_FINER = 4  # times, that a surface is drawn which stays as it is
_SEARCH = 12.0  # pixels around its projection within which a landmark may be found again


def lift(
    known: ObjectMap, camera: Camera, view: View, pixel: NDArray[np.float32]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Surface points ``(N, 3)`` at pixels ``(N, 2)`` of the full frame, and which pixels meet the surface.

    The depth is that of the window's nearest drawn pixel; of a surface that is held it is drawn finer, since no
    bundle adjustment puts its points right.
    """
    observation, finer = view.observation, _FINER if known.held else 1
    size, K = finer * observation.window.size, observation.K
    if finer > 1:
        K = K * K.new_tensor([[finer], [finer], [1.0]])
        K[:2, 2] += (finer - 1) / 2  # pixel centres stay at integers
    screen, depth = project_vertices(known.vertices, view.pose.R[None], view.pose.translation[None], K[None])
    drawn = rasterize(screen, depth, known.shape.faces, (size, size), known.renderer).depth[0].cpu().numpy()
    in_window = (to_window(view, pixel) + 0.5) * finer - 0.5
    column, row = np.clip(np.rint(in_window), 0, size - 1).astype(int).T
    inside = (np.abs(in_window - (size - 1) / 2) <= size / 2).all(1)
    # The deepest of the neighbours is the background; the nearest would cut corners off the outline.
    z = drawn[row, column]
    met = inside & np.isfinite(z)
    z = np.where(met, z, 1.0)
    ray = (pixel - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    x_cam = np.concatenate([ray, np.ones((len(ray), 1))], 1) * z[:, None]
    R, t = pose_arrays(view.pose)
    return (x_cam - t) @ R, met


def mask_weight(mask: NDArray[np.bool_] | None, points: FollowedPoints) -> float:
    """How far a mask is believed, by the share of points on the object that lie inside it."""
    if mask is None or len(points) < _FEWEST_WITNESSES:
        return 1.0
    reach = max(round(0.02 * float(np.sqrt(mask.sum()))), 1)
    wide = cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
    x, y = np.rint(points.pixel).astype(int).T
    inside = wide[y.clip(0, mask.shape[0] - 1), x.clip(0, mask.shape[1] - 1)].mean()
    return float(np.clip((inside - 0.75) / 0.2, 0.02, 1.0))


def well_inside(
    mask: NDArray[np.bool_] | None, silhouette: NDArray[np.bool_], pixel: NDArray[np.float32], margin: float
) -> NDArray[np.bool_]:
    """``(N,)`` whether pixels lie in the mask or the silhouette, and at least ``margin`` from the outline of both.

    What lies on an occluding outline slides over the surface as the object turns.
    """
    covered = silhouette if mask is None else mask | silhouette
    depth = cv2.distanceTransform(covered.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    x, y = np.rint(pixel).astype(int).T
    return np.asarray(depth[y.clip(0, depth.shape[0] - 1), x.clip(0, depth.shape[1] - 1)] > margin)


def to_window(view: View, pixel: NDArray[np.float32]) -> FloatArray:
    """``(N, 2)`` pixels of the full frame in the view's window."""
    window = view.observation.window
    return np.asarray((pixel.astype(np.float64) + 0.5 - [window.left, window.top]) * window.scale - 0.5)


def pose_arrays(pose: Pose) -> tuple[FloatArray, FloatArray]:
    """Rotation ``(3, 3)`` and translation ``(3,)`` in float64."""
    T_cam_obj = pose.matrix().numpy()
    return T_cam_obj[:3, :3], T_cam_obj[:3, 3]


def project_points(points: FloatArray, pose: Pose, camera: Camera) -> FloatArray:
    """``(N, 2)`` pixels of the full frame of points in object coordinates."""
    R, t = pose_arrays(pose)
    x_cam = points @ R.T + t
    return x_cam[:, :2] / np.maximum(x_cam[:, 2:], 1e-6) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def with_landmarks(
    known: ObjectMap, camera: Camera, view: View, keypoints: Keypoints, corners: NDArray[np.float32]
) -> tuple[ObjectMap, View]:
    """Name every keypoint and corner of a view: a landmark that is followed, found again, or new.

    Args:
        known: The map.
        camera: Of the full frame.
        view: With the points that were followed into it.
        keypoints: Found in it.
        corners: ``(N, 2)`` further pixels to make landmarks of.
    """
    label = np.full(len(keypoints), -1, np.int64)
    followed = view.points
    if len(followed) and len(keypoints):
        gap = np.linalg.norm(keypoints.pixel[:, None] - followed.pixel[None], axis=2)
        nearest = gap.argmin(1)
        label = np.where(gap[np.arange(len(gap)), nearest] < _SAME_PLACE, followed.landmark[nearest], -1)
    taken = set(followed.landmark.tolist())
    limit = _SEARCH * max(1.0, view.observation.window.side / 200)
    for other in nearest_views(known.keyframes, view.pose, 4):
        pairs = match(keypoints, other.keypoints)
        pairs = pairs[label[pairs[:, 0]] < 0]
        landmark = other.keypoint_landmark[pairs[:, 1]]
        known_here = landmark >= 0
        pairs, landmark = pairs[known_here], landmark[known_here]
        place = project_points(known.landmarks[landmark], view.pose, camera)
        near = np.linalg.norm(place - keypoints.pixel[pairs[:, 0]], axis=1) < limit
        for position, name in zip(pairs[near, 0], landmark[near], strict=True):
            if name not in taken:
                label[position] = name
                taken.add(int(name))
    fresh = np.flatnonzero(label < 0)
    # Two keypoints at one place are one landmark.
    pixels = np.concatenate([keypoints.pixel[fresh], corners])
    points, met = lift(known, camera, view, pixels) if len(pixels) else (np.zeros((0, 3)), np.zeros(0, bool))
    names = np.full(len(pixels), -1, np.int64)
    names[met] = len(known.landmarks) + np.arange(met.sum())
    landmarks = np.concatenate([known.landmarks, points[met]])
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
    candidate = np.concatenate([known.candidate, np.zeros(len(landmarks) - len(known.landmarks), bool)])
    return replace(known, landmarks=landmarks, candidate=candidate), named


def nearest_views(keyframes: tuple[View, ...], pose: Pose, most: int) -> list[View]:
    """The keyframes whose viewing direction of the object is nearest to a pose's."""
    if not keyframes:
        return []
    angles = [viewing_angle(view.pose, pose) for view in keyframes]
    return [keyframes[i] for i in np.argsort(angles, kind="stable")[:most]]


def viewing_angle(a: Pose, b: Pose) -> float:
    """Degrees between the directions in which two poses show the object."""
    directions = []
    for pose in (a, b):
        R, t = pose_arrays(pose)
        direction = -R.T @ t
        directions.append(direction / max(float(np.linalg.norm(direction)), 1e-9))
    return float(np.degrees(np.arccos(np.clip(directions[0] @ directions[1], -1, 1))))


def window_of(count: int, most: int) -> list[int]:
    """Positions of the keyframes that are refined together: the first, half recent, half spread over the older."""
    if count <= most:
        return list(range(count))
    recent = list(range(count - most // 2, count))
    older = np.linspace(0, count - most // 2 - 1, most - len(recent)).round().astype(int).tolist()
    return sorted({*older, *recent})


def refine_map(
    known: ObjectMap,
    camera: Camera,
    positions: list[int],
    *,
    weights: FitWeights,
    prior: float,
    scale: float = 1.0,
    bundle_iterations: int = 10,
    rounds: int = 1,
) -> ObjectMap:
    """Poses and landmarks by bundle adjustment, then the shape by outlines and landmarks, then the texture.

    Args:
        known: The map.
        camera: Of the full frame.
        positions: Which keyframes take part, rising; the first one does not move.
        weights: Of the shape's terms.
        prior: What a landmark at distance 1 from the surface costs, see `bundle.adjust`.
        scale: Pixels, of the robust loss.
        bundle_iterations: Of the bundle adjustment.
        rounds: Of the shape.
    """
    known = _bundled(known, camera, positions, prior, scale, bundle_iterations)
    known = fit_shape(known, positions, weights, rounds)
    keyframes = list(known.keyframes)
    for position in positions:
        view = keyframes[position]
        keyframes[position] = replace(view, texture=known.back_project(view.observation.features, view))
    return replace(known, keyframes=tuple(keyframes))


def _bundled(
    known: ObjectMap, camera: Camera, positions: list[int], prior: float, scale: float, iterations: int
) -> ObjectMap:
    views = [known.keyframes[position] for position in positions]
    names = shared_landmarks(known, views)
    if len(names) < _FEWEST_BUNDLED or len(views) < 2:
        return known
    tracks, start = tracks_of(views, names), structure_of(known, views, names)
    places = surface_places(known, camera, views, names)
    found = adjust(
        tracks, camera.K, start, fixed=1, scale=scale, iterations=iterations,
        point_prior=places, point_prior_weight=prior,
    )  # fmt: skip
    landmarks = known.landmarks.copy()
    sound = np.isfinite(found.points).all(1)
    landmarks[names[sound]] = found.points[sound]
    keyframes = list(known.keyframes)
    for n, position in enumerate(positions):
        keyframes[position] = replace(
            keyframes[position], pose=pose_of(found.R[n], found.t[n], known.vertices)
        )
        residual = found.residual[n]
        bad = names[np.nan_to_num(residual, nan=0.0) > 4 * scale]
        if len(bad):
            view = keyframes[position]
            keyframes[position] = replace(view, points=view.points.only(~np.isin(view.points.landmark, bad)))
    # Landmarks seen once move with the surface.
    return replace(known, landmarks=landmarks, keyframes=tuple(keyframes))


def shared_landmarks(known: ObjectMap, views: list[View]) -> NDArray[np.int64]:
    """Landmarks that two of the views or more show, rising; those that most show hold the poses together."""
    names, counts = np.unique(np.concatenate([view.points.landmark for view in views]), return_counts=True)
    usable = (counts >= 2) & ~known.candidate[names]
    names, counts = names[usable], counts[usable]
    return np.sort(names[np.argsort(-counts, kind="stable")[:_MOST_BUNDLED]])


def structure_of(known: ObjectMap, views: list[View], names: NDArray[np.int64]) -> Structure:
    """The views' poses and the named landmarks as they stand."""
    poses = [pose_arrays(view.pose) for view in views]
    return Structure(np.array([R for R, _ in poses]), np.array([t for _, t in poses]), known.landmarks[names])


def surface_places(
    known: ObjectMap, camera: Camera, views: list[View], names: NDArray[np.int64]
) -> FloatArray:
    """``(N, 3)`` where the surface is at the pixel of each landmark's first view; nan where there is none."""
    places = np.full((len(names), 3), np.nan)
    for view in views:
        open_ = np.isnan(places[:, 0]) & np.isin(names, view.points.landmark)
        if not open_.any():
            continue
        order = {int(name): i for i, name in enumerate(view.points.landmark)}
        rows = np.array([order[int(name)] for name in names[open_]])
        points, met = lift(known, camera, view, view.points.pixel[rows])
        places[np.flatnonzero(open_)[met]] = points[met]
    return places


def tracks_of(views: list[View], names: NDArray[np.int64]) -> Tracks:
    """Where the views show the named landmarks (rising)."""
    pixels = np.full((len(views), len(names), 2), np.nan)
    for row, view in enumerate(views):
        place = np.searchsorted(names, view.points.landmark)
        inside = place < len(names)
        inside[inside] &= names[place[inside]] == view.points.landmark[inside]
        pixels[row, place[inside]] = view.points.pixel[inside]
    return Tracks(pixels, np.isfinite(pixels[..., 0]))


def pose_of(R: FloatArray, t: FloatArray, like: Tensor) -> Pose:
    """A pose from arrays."""
    return from_matrix(
        torch.from_numpy(np.ascontiguousarray(R)).to(like), torch.from_numpy(np.ascontiguousarray(t)).to(like)
    )


def fit_shape(known: ObjectMap, positions: list[int], weights: FitWeights, rounds: int) -> ObjectMap:
    """The vertices anew, by the outlines of the keyframes at these positions and the landmarks they show."""
    if not rounds:
        return known
    views = [known.keyframes[position] for position in positions]
    observations = [view.observation for view in views]
    poses = Pose.stack([view.pose for view in views])
    seen = ShapeKeyframes(
        poses.R,
        poses.translation,
        torch.stack([o.K for o in observations]),
        torch.stack([o.outline_distance for o in observations]),
        torch.tensor([v.mask_weight * v.observation.has_mask for v in views]).to(known.vertices),
    )
    names, number = np.unique(np.concatenate([v.points.landmark for v in views]), return_counts=True)
    names = names[(number >= 2) & ~known.candidate[names] & np.isfinite(known.landmarks[names]).all(1)]
    which = np.full(len(known.landmarks), -1)
    for n, view in enumerate(views):
        which[view.points.landmark] = n
    landmarks = Landmarks(
        torch.from_numpy(known.landmarks[names]).to(known.vertices), torch.from_numpy(which[names])
    )
    vertices = fit_surface(
        known.vertices, known.shape.rest, known.shape.faces, known.shape.face_uvs, known.shape.laplacian, seen,
        landmarks, weights, rounds, known.renderer,
    )  # fmt: skip
    return replace(known, vertices=flatten(vertices) if known.shape.flat else vertices)
