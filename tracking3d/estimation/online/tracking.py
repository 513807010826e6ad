"""The pose of one frame against the map: cheap starts first, costly ones only where those look wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.judgement import Support
from tracking3d.estimation.online.keypoints import Keypoints, detect, match
from tracking3d.estimation.online.mapping import (
    nearest_views,
    pose_of,
    project_points,
    to_window,
    well_inside,
)
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.pose_from_points import pose_from_points
from tracking3d.estimation.online.pose_refinement import refine_pose, refine_poses
from tracking3d.estimation.online.pose_refinement_types import PoseFit, PoseWeights
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, extrapolate, from_matrix, rotation_about
from tracking3d.rendering import MatchedPoints, Surface

ENOUGH_MATURE = 30
"""With so many landmarks of two keyframes or more, those of one alone are not asked."""
_FEWEST_POINTS = 6  # for a pose from points
_INLIER = 3.0  # pixels of an object 200 pixels large
_EDGE = 8.0  # such pixels from the outline within which points slide
_STRAY, _STRAY_YOUNG = 4.0, 16.0  # such pixels that a point may be off
_KEYFRAMES = 6  # that a doubtful frame is matched with
_GRID_ANGLES = (20.0, 40.0)
_GRID_FINALISTS = 5
_OFTEN = 5  # frames after a loss in which turns are tried in every one, and later in one of so many
_COASTS = 12  # frames
_WITNESS, _MOST_WITNESSES = 0.005, 30  # what each agreeing landmark takes off the cost, and how many do
_PLACED = 8  # keyframes whose poses a lost object is looked for at


def coast(trail: tuple[tuple[Pose, int], ...], index: int) -> Pose:
    """Where an object is that is not seen: moving on as it did, for a while.

    Args:
        trail: Believed poses and their frame indices, in order of time; at least one.
        index: Of the frame.
    """
    (first, begin), (last, end) = trail[0], trail[-1]
    if begin == end:
        return last
    return extrapolate(first, last, min(index - end, _COASTS) / (end - begin))


def pixel_scale(view: View) -> float:
    """How much larger than 200 pixels a view's window is; at least 1. Tolerances in pixels go with it."""
    return max(1.0, view.observation.window.side / 200)


def fit_pose(
    known: ObjectMap,
    surface: Surface,
    view: View,
    starts: dict[str, Pose],
    points: FollowedPoints,
    weights: PoseWeights,
) -> tuple[str, PoseFit]:
    """The best start, and the pose refined from it."""
    weights = replace(weights, outline=weights.outline * view.mask_weight)
    matched = _matched(known, surface, view, points)
    name = next(iter(starts))
    if len(starts) > 1:
        fits = refine_poses(surface, view.observation, list(starts.values()), matched, weights, (0,))
        name, _ = min(zip(starts, fits, strict=True), key=lambda one: one[1].cost)
    return name, refine_pose(surface, view.observation, starts[name], matched, weights)


def pose_of_points(
    known: ObjectMap, camera: Camera, points: FollowedPoints, scale: float
) -> tuple[Pose, FollowedPoints] | None:
    """The pose that most points agree with, and those that do; for the scale see `pixel_scale`."""
    position = known.landmarks[points.landmark]
    if np.isfinite(position).all(1).sum() < _FEWEST_POINTS:
        return None
    found = pose_from_points(
        position, points.pixel.astype(np.float64), camera.K, threshold=_INLIER * scale, seed=0
    )
    if found is None or found.count < _FEWEST_POINTS:
        return None
    return pose_of(found.R, found.t, known.vertices), points.only(found.inliers)


def agreeing(
    known: ObjectMap, camera: Camera, pose: Pose, points: FollowedPoints, view: View
) -> FollowedPoints:
    """Points that are where a pose says and not on the outline; of candidates neither is asked."""
    if not len(points):
        return points
    gap = np.linalg.norm(
        project_points(known.landmarks[points.landmark], pose, camera) - points.pixel, axis=1
    )
    young = known.sightings[points.landmark] < 2
    scale = pixel_scale(view)
    in_place = np.isnan(gap) | (gap < np.where(young, _STRAY_YOUNG, _STRAY) * scale)
    inside = well_inside(view.mask, known.silhouette(pose, camera), points.pixel, _EDGE * scale)
    return points.only(in_place & (inside | known.candidate[points.landmark]))


def supported(known: ObjectMap, camera: Camera, pose: Pose, agree: FollowedPoints, view: View) -> Support:
    """What speaks for a pose beside its losses; ``agree`` are the points that do."""
    names = view.points.landmark
    told = (
        np.isfinite(known.landmarks[names]).all(1) & (known.sightings[names] >= 2) & ~known.candidate[names]
    )
    gap = project_points(known.landmarks[names[told]], pose, camera) - view.points.pixel[told]
    stray = np.linalg.norm(gap, axis=1) > _STRAY * pixel_scale(view)
    strays = float(stray.mean()) if len(stray) else 0.0
    return Support(witnesses(known, agree), strays, view.mask_weight, view.mask is not None, known.pointless)


def rematched(
    known: ObjectMap, camera: Camera, view: View, image: NDArray[np.uint8], anywhere: bool
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from keypoints that are matched with keyframes, most agreeing points first.

    Args:
        known: The map.
        camera: Of the full frame.
        view: The frame, with the best pose so far.
        image: ``(H, W)`` grey.
        anywhere: Ask more keyframes than those with the nearest viewing direction.
    """
    region = np.ones(image.shape, bool) if view.mask is None else view.mask
    others = nearest_views(known.keyframes, view.pose, len(known.keyframes) if anywhere else _KEYFRAMES)
    keypoints = detect(image, region)
    return matched_poses(known, camera, keypoints, others[: 4 * _KEYFRAMES], pixel_scale(view))[:3]


def matched_poses(
    known: ObjectMap, camera: Camera, keypoints: Keypoints, others: Sequence[View], scale: float
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses by the matches with one keyframe each, most agreeing points first.

    Args:
        known: The map.
        camera: Of the full frame.
        keypoints: Of a frame.
        others: The keyframes.
        scale: See `pixel_scale`.
    """
    found = []
    for other in others:
        pairs = match(keypoints, other.keypoints)
        names = other.keypoint_landmark[pairs[:, 1]]
        sound = (names >= 0) & ~known.candidate[names]
        points = FollowedPoints(names[sound], keypoints.pixel[pairs[sound, 0]])
        pose = pose_of_points(known, camera, points, scale)
        if pose is not None:
            found.append(pose)
    found.sort(key=lambda one: -len(one[1]))
    return found


def placed(pose: Pose, camera: Camera, mask: NDArray[np.bool_]) -> Pose:
    """A pose moved in front of the camera, at its depth, to where a mask ``(H, W)`` is."""
    x1, y1 = np.argwhere(mask)[:, ::-1].mean(0)
    x, y, z = pose.translation.tolist()
    shift = [(x1 - camera.cx) / camera.fx * z - x, (y1 - camera.cy) / camera.fy * z - y, 0.0]
    return Pose(pose.translation + pose.translation.new_tensor(shift), pose.quaternion)


def placed_keyframes(known: ObjectMap, camera: Camera, view: View) -> list[Pose]:
    """The poses of keyframes, moved in front of the camera to where the mask is."""
    if view.mask is None:
        return []
    count = len(known.keyframes)
    chosen = np.unique(np.linspace(0, count - 1, _PLACED).round().astype(int))
    return [placed(known.keyframes[position].pose, camera, view.mask) for position in chosen]


def turned_grid(surface: Surface, view: View, pose: Pose, weights: PoseWeights) -> list[Pose]:
    """The best of many rotations around a pose, by appearance and outline at half the resolution."""
    small = view.observation.half
    weights = replace(weights, outline=weights.outline * view.mask_weight)
    directions = [
        torch.tensor(axis, dtype=pose.translation.dtype)
        for axis in product((-1.0, 0.0, 1.0), repeat=3)
        if any(axis)
    ]
    poses = [
        from_matrix(rotation_about(axis.to(pose.translation), angle) @ pose.R, pose.translation)
        for axis in directions
        for angle in _GRID_ANGLES
    ]
    costs = [fit.cost for fit in refine_poses(surface, small, poses, None, weights, (0,))]
    best = np.argsort(np.nan_to_num(costs, nan=math.inf))[:_GRID_FINALISTS]
    finalists = [poses[place] for place in best]
    return [fit.pose for fit in refine_poses(surface, small, finalists, None, weights, (4,))]


def worth_trying(frames: int) -> bool:
    """Whether to try once more what has not helped for so many frames: at first always, and then now and again."""
    return frames <= _OFTEN or frames % _OFTEN == 0


Found = tuple[str, PoseFit, FollowedPoints]
"""Which start won, the pose, and the points that agree with it."""


def searched(
    known: ObjectMap,
    surface: Surface,
    camera: Camera,
    view: View,
    image: NDArray[np.uint8],
    best: Found,
    weights: PoseWeights,
    lost_for: int,
) -> Found:
    """The best of what was found so far and of the costly hypotheses, by what re-renders the frame.

    Args:
        known: The map; surface: its surface.
        camera: Of the full frame.
        view: The frame.
        image: ``(H, W)`` grey.
        best: What was found so far.
        weights: Of the kinds of evidence.
        lost_for: How many frames the object has been lost before this one: if it was, all sides of it are looked at,
            wherever it was before, but the longer the less often.
    """
    lost = lost_for > 0

    def fitted(name: str, pose: Pose, points: FollowedPoints, asked: FollowedPoints) -> Found:
        _, fit = fit_pose(known, surface, view, {name: pose}, points, weights)
        return name, fit, agreeing(known, camera, fit.pose, asked, view)

    tried = [best]
    for pose, points in rematched(known, camera, replace(view, pose=best[1].pose), image, lost):
        tried.append(fitted("keyframe", pose, points, points))
    if view.mask is not None and (worth_trying(lost_for)):
        centre = best[1].pose
        if lost:
            placed = {str(n): pose for n, pose in enumerate(placed_keyframes(known, camera, view))}
            centre = fit_pose(known, surface, view, placed, FollowedPoints.none(), weights)[1].pose
        for pose in turned_grid(surface, view, centre, weights):
            tried.append(fitted("grid", pose, FollowedPoints.none(), view.points))
    return min(
        tried,
        key=lambda one: standing(one[1], weights, view.mask_weight, witnesses(known, one[2])),
    )


def standing(fit: PoseFit, weights: PoseWeights, mask_weight: float, agreed: int) -> float:
    """What tells the best of several poses, the lowest: what each costs, less what ``agreed`` landmarks take off."""
    return evidence(fit, weights, mask_weight) - _WITNESS * min(agreed, _MOST_WITNESSES)


def witnesses(known: ObjectMap, points: FollowedPoints) -> int:
    """How many of the points are landmarks that two keyframes have seen."""
    return int((known.sightings[points.landmark] >= 2).sum())


def evidence(fit: PoseFit, weights: PoseWeights, mask_weight: float) -> float:
    """What poses from different points are compared by: the cost without them."""
    missed = mask_weight * (1 - fit.overlap)
    return weights.appearance * fit.appearance + weights.outline * mask_weight * fit.outline + missed


def _matched(known: ObjectMap, surface: Surface, view: View, points: FollowedPoints) -> MatchedPoints:
    position = known.landmarks[points.landmark]
    sound = np.isfinite(position).all(1)
    # A landmark seen once lies where the shape was believed to be: with others at hand it is no witness.
    mature = sound & (known.sightings[points.landmark] >= 2)
    if mature.sum() >= ENOUGH_MATURE:
        sound = mature
    return MatchedPoints(
        torch.from_numpy(position[sound]).to(surface.vertices),
        torch.from_numpy(to_window(view, points.pixel[sound])).to(surface.vertices),
    )
