"""The pose of one frame against the map: cheap starts first, costly ones only where those look wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.mapping.local_mapping import is_well_inside, project_points, to_window
from tracking3d.estimation.online.optimization.pnp import pose_from_points
from tracking3d.estimation.online.optimization.pose_refinement import refine_pose, refine_poses, render_cost
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.state.confidence import PoseEvidence
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_from_arrays
from tracking3d.rendering import MatchedPoints, Surface

ENOUGH_MATURE = 30
"""With so many landmarks of two keyframes or more, those of one alone are not asked."""
_MIN_INLIERS = 6  # for a pose from points
_MAX_INLIER_ERROR = 3.0  # pixels of an object 200 pixels large
_OUTLINE_MARGIN = 8.0  # such pixels from the outline within which points slide
_MAX_REPROJECTION_ERROR, _MAX_REPROJECTION_ERROR_NEW = 4.0, 16.0  # such pixels that a point may be off
_INLIER_REWARD, _MAX_REWARDED_INLIERS = (
    0.005,
    30,
)  # what each agreeing landmark takes off the cost, and how many do


def pixel_scale(view: Keyframe) -> float:
    """How much larger than 200 pixels a view's window is; at least 1. Tolerances in pixels go with it."""
    return max(1.0, view.observation.window.side / 200)


def fit_pose(
    object_map: ObjectMap,
    surface: Surface,
    view: Keyframe,
    starts: dict[str, Pose],
    points: FollowedPoints,
    weights: PoseWeights,
) -> tuple[str, PoseFit]:
    """The best start, and the pose refined from it."""
    weights = replace(weights, outline=weights.outline * view.mask_weight)
    matched = _matched_points(object_map, surface, view, points)
    name = next(iter(starts))
    if len(starts) > 1:
        fits = refine_poses(surface, view.observation, list(starts.values()), matched, weights, (0,))
        name, _ = min(zip(starts, fits, strict=True), key=lambda one: one[1].cost)
    return name, refine_pose(surface, view.observation, starts[name], matched, weights)


def pose_of_points(
    object_map: ObjectMap, camera: Camera, points: FollowedPoints, scale: float
) -> tuple[Pose, FollowedPoints] | None:
    """The pose that most points agree with, and those that do; for the scale see `pixel_scale`."""
    position = object_map.landmarks[points.landmark]
    if np.isfinite(position).all(1).sum() < _MIN_INLIERS:
        return None
    found = pose_from_points(
        position, points.pixel.astype(np.float64), camera.K, threshold=_MAX_INLIER_ERROR * scale, seed=0
    )
    if found is None or found.count < _MIN_INLIERS:
        return None
    return pose_from_arrays(found.R, found.t, object_map.vertices), points.only(found.inliers)


def find_inliers(
    object_map: ObjectMap, camera: Camera, pose: Pose, points: FollowedPoints, view: Keyframe
) -> FollowedPoints:
    """Points that are where a pose says and not on the outline; of candidates neither is asked."""
    if not len(points):
        return points
    gap = np.linalg.norm(
        project_points(object_map.landmarks[points.landmark], pose, camera) - points.pixel, axis=1
    )
    young = object_map.sightings[points.landmark] < 2
    scale = pixel_scale(view)
    in_place = np.isnan(gap) | (
        gap < np.where(young, _MAX_REPROJECTION_ERROR_NEW, _MAX_REPROJECTION_ERROR) * scale
    )
    inside = is_well_inside(
        view.mask, object_map.silhouette(pose, camera), points.pixel, _OUTLINE_MARGIN * scale
    )
    return points.only(in_place & (inside | object_map.candidate[points.landmark]))


def pose_evidence(
    object_map: ObjectMap, camera: Camera, pose: Pose, agree: FollowedPoints, view: Keyframe
) -> PoseEvidence:
    """What speaks for a pose beside its losses; ``agree`` are the points that do."""
    names = view.points.landmark
    told = (
        np.isfinite(object_map.landmarks[names]).all(1)
        & (object_map.sightings[names] >= 2)
        & ~object_map.candidate[names]
    )
    gap = project_points(object_map.landmarks[names[told]], pose, camera) - view.points.pixel[told]
    stray = np.linalg.norm(gap, axis=1) > _MAX_REPROJECTION_ERROR * pixel_scale(view)
    strays = float(stray.mean()) if len(stray) else 0.0
    return PoseEvidence(
        count_inliers(object_map, agree),
        strays,
        view.mask_weight,
        view.mask is not None,
        object_map.pointless,
    )


def candidate_cost(fit: PoseFit, weights: PoseWeights, mask_weight: float, agreed: int) -> float:
    """What tells the best of several poses, the lowest: what each costs, less what ``agreed`` landmarks take off."""
    return render_cost(fit, weights, mask_weight) - _INLIER_REWARD * min(agreed, _MAX_REWARDED_INLIERS)


def count_inliers(object_map: ObjectMap, points: FollowedPoints) -> int:
    """How many of the points are landmarks that two keyframes have seen."""
    return int((object_map.sightings[points.landmark] >= 2).sum())


def _matched_points(
    object_map: ObjectMap, surface: Surface, view: Keyframe, points: FollowedPoints
) -> MatchedPoints:
    position = object_map.landmarks[points.landmark]
    sound = np.isfinite(position).all(1)
    # A landmark seen once lies where the shape was believed to be: with others at hand it is no witness.
    mature = sound & (object_map.sightings[points.landmark] >= 2)
    if mature.sum() >= ENOUGH_MATURE:
        sound = mature
    return MatchedPoints(
        torch.from_numpy(position[sound]).to(surface.vertices),
        torch.from_numpy(to_window(view, points.pixel[sound])).to(surface.vertices),
    )
