"""The pose of one frame against the map: cheap hypotheses first, costly ones only if those look wrong."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.texture_strength import has_texture
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
"""If so many landmarks were seen by two keyframes or more, landmarks seen by only one are not used."""
_MIN_INLIERS = 6  # fewest points of a pose by PnP
_MAX_INLIER_ERROR = 3.0  # largest reprojection error of an inlier, in pixels at an object size of 200 pixels
_OUTLINE_MARGIN = 8.0  # such pixels from the outline within which points slide over the surface
_MAX_REPROJECTION_ERROR, _MAX_REPROJECTION_ERROR_NEW = (
    4.0,
    16.0,
)  # such pixels, beyond which a point is an outlier
_INLIER_REWARD, _MAX_REWARDED_INLIERS = (
    0.005,
    30,
)  # taken off the cost for each inlier, and for how many at most


def pixel_scale(view: Keyframe) -> float:
    """A view's window size relative to 200 pixels, at least 1. Tolerances in pixels scale with it."""
    return max(1.0, view.observation.window.side / 200)


def fit_pose(
    object_map: ObjectMap,
    surface: Surface,
    view: Keyframe,
    starts: dict[str, Pose],
    points: FollowedPoints,
    weights: PoseWeights,
) -> tuple[str, PoseFit]:
    """The best initial pose, and the pose refined from it."""
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
    """The pose with most inliers by PnP, and the inliers; for the scale see `pixel_scale`."""
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
    """Points whose reprojection error is small and that lie off the outline; candidate landmarks are not used."""
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
    """The evidence for a pose apart from its losses; ``agree`` are its inliers."""
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
        has_texture([one.strength for one in object_map.keyframes if math.isfinite(one.strength)]),
        None if object_map.free_axis is None else object_map.free_axis.direction,
    )


def candidate_cost(fit: PoseFit, weights: PoseWeights, mask_weight: float, agreed: int) -> float:
    """The cost by which pose candidates are compared: a pose's cost, less a reward for ``agreed`` inliers."""
    return render_cost(fit, weights, mask_weight) - _INLIER_REWARD * min(agreed, _MAX_REWARDED_INLIERS)


def count_inliers(object_map: ObjectMap, points: FollowedPoints) -> int:
    """How many of the points are landmarks that at least two keyframes have seen."""
    return int((object_map.sightings[points.landmark] >= 2).sum())


def _matched_points(
    object_map: ObjectMap, surface: Surface, view: Keyframe, points: FollowedPoints
) -> MatchedPoints:
    position = object_map.landmarks[points.landmark]
    sound = np.isfinite(position).all(1)
    # A landmark seen once lies on the estimated surface: it is no independent evidence if there are others.
    mature = sound & (object_map.sightings[points.landmark] >= 2)
    if mature.sum() >= ENOUGH_MATURE:
        sound = mature
    return MatchedPoints(
        torch.from_numpy(position[sound]).to(surface.vertices),
        torch.from_numpy(to_window(view, points.pixel[sound])).to(surface.vertices),
    )
