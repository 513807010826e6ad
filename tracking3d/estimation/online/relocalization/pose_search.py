"""A pose without a prediction: matched keyframes and a grid of rotations, compared by how they re-render the frame."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.optimization.pose_refinement import refine_poses
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.relocalization.keypoint_matching import match_keyframes
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.tracking.motion_model import align_to_mask
from tracking3d.estimation.online.tracking.pose_tracking import (
    candidate_cost,
    count_inliers,
    find_inliers,
    fit_pose,
)
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix, rotation_about
from tracking3d.rendering import Surface

ROTATION_SEARCH = "rotation_search"
"""The name of the hypothesis that is the best of many rotations around the predicted pose."""
_GRID_ANGLES = (20.0, 40.0)
_GRID_FINALISTS = 5
_RETRY_INTERVAL = 5  # frames after a loss with a search in each; later, only every n-th frame
_MAX_ALIGNED_KEYFRAMES = 8  # most keyframes whose poses are tried for a lost object


def aligned_keyframes(object_map: ObjectMap, camera: Camera, view: Keyframe) -> list[Pose]:
    """The poses of keyframes, shifted parallel to the image plane to where the mask is."""
    if view.mask is None:
        return []
    count = len(object_map.keyframes)
    chosen = np.unique(np.linspace(0, count - 1, _MAX_ALIGNED_KEYFRAMES).round().astype(int))
    return [align_to_mask(object_map.keyframes[position].pose, camera, view.mask) for position in chosen]


def search_rotations(surface: Surface, view: Keyframe, pose: Pose, weights: PoseWeights) -> list[Pose]:
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


def should_retry(frames: int) -> bool:
    """Whether to repeat a search that has failed for so many frames: always at first, then at intervals."""
    return frames <= _RETRY_INTERVAL or frames % _RETRY_INTERVAL == 0


Found = tuple[str, PoseFit, FollowedPoints]
"""The best hypothesis' name, its pose, and its inliers."""


def relocalize(
    object_map: ObjectMap,
    surface: Surface,
    camera: Camera,
    view: Keyframe,
    image: NDArray[np.uint8],
    best: Found,
    weights: PoseWeights,
    lost_for: int,
) -> Found:
    """The best of the candidate so far and the costly hypotheses, by how they re-render the frame.

    Args:
        object_map: The map; surface: Its surface.
        camera: The camera of the full frame.
        view: The frame.
        image: ``(H, W)`` grey.
        best: The best candidate so far.
        weights: The weights of the cost terms.
        lost_for: For how many frames the object had been lost before this one. If it was lost, all of its sides are
            tried, whatever the last pose was, but less often the longer it has been lost.
    """
    lost = lost_for > 0

    def fitted(name: str, pose: Pose, points: FollowedPoints, asked: FollowedPoints) -> Found:
        _, fit = fit_pose(object_map, surface, view, {name: pose}, points, weights)
        return name, fit, find_inliers(object_map, camera, fit.pose, asked, view)

    tried = [best]
    for pose, points in match_keyframes(object_map, camera, replace(view, pose=best[1].pose), image, lost):
        tried.append(fitted("keyframe", pose, points, points))
    if view.mask is not None and (should_retry(lost_for)):
        centre = best[1].pose
        if lost:
            placed = {str(n): pose for n, pose in enumerate(aligned_keyframes(object_map, camera, view))}
            centre = fit_pose(object_map, surface, view, placed, FollowedPoints.none(), weights)[1].pose
        for pose in search_rotations(surface, view, centre, weights):
            tried.append(fitted(ROTATION_SEARCH, pose, FollowedPoints.none(), view.points))
    return min(
        tried,
        key=lambda one: candidate_cost(one[1], weights, view.mask_weight, count_inliers(object_map, one[2])),
    )
