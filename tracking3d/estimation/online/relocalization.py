"""A pose without a prediction: matched keyframes and a grid of rotations, compared by how they re-render the frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ELSEWHERE
from tracking3d.estimation.observation import projected_box
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import SIFT, Detector, Keypoints, detect_turned, match
from tracking3d.estimation.online.mapping.local_mapping import nearest_views
from tracking3d.estimation.online.optimization.pose_refinement import refine_poses
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.pose_tracking import (
    align_to_mask,
    candidate_cost,
    count_inliers,
    find_inliers,
    fit_pose,
    pixel_scale,
    pose_of_points,
)
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.state.solver_state import Mapped
from tracking3d.frames import mask_iou_or_none
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix, pose_arrays, rotation_about
from tracking3d.rendering import Surface

ROTATION_SEARCH = "rotation_search"
"""The name of the hypothesis that is the best of many rotations around the predicted pose."""
_GRID_ANGLES = (20.0, 40.0)
_GRID_FINALISTS, _GRID_KEPT = 5, 2
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
    refined = refine_poses(surface, small, finalists, None, weights, (4,))
    return [fit.pose for fit in sorted(refined, key=lambda one: one.cost)[:_GRID_KEPT]]


def should_retry(frames: int) -> bool:
    """Whether to repeat a search that has failed for so many frames: always at first, then at intervals."""
    return frames <= _RETRY_INTERVAL or frames % _RETRY_INTERVAL == 0


Found = tuple[str, PoseFit, FollowedPoints]
"""The best hypothesis' name, its pose, and its inliers."""


def relocalize(
    state: Mapped,
    view: Keyframe,
    image: NDArray[np.uint8],
    best: Found,
    weights: PoseWeights,
    detector: Detector = SIFT,
) -> Found:
    """The best of the candidate so far and the costly hypotheses, by how they re-render the frame.

    If the object was lost, all of its sides are tried, whatever the last pose was, but less often the longer it has
    been lost.

    Args:
        state: The state before the frame.
        view: The frame.
        image: ``(H, W)`` grey.
        best: The best candidate so far.
        weights: The weights of the cost terms.
        detector: What finds keypoints.
    """
    object_map, surface, camera, lost = state.object_map, state.surface, state.camera, state.lost

    def fitted(name: str, pose: Pose, points: FollowedPoints, asked: FollowedPoints) -> Found:
        _, fit = fit_pose(object_map, surface, view, {name: pose}, points, weights)
        return name, fit, find_inliers(object_map, camera, fit.pose, asked, view)

    tried = [best]
    seen = replace(view, pose=best[1].pose)
    for pose, points in match_keyframes(object_map, camera, seen, image, lost, detector):
        tried.append(fitted("keyframe", pose, points, points))
    if view.mask is not None and should_retry(state.lost_frames):
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


_MAX_KEYFRAMES = 6  # most keyframes that a doubtful frame is matched with


def match_keyframes(
    object_map: ObjectMap,
    camera: Camera,
    view: Keyframe,
    image: NDArray[np.uint8],
    anywhere: bool,
    detector: Detector = SIFT,
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from keypoints matched with keyframes, most inliers first.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        view: The frame, with the best pose so far.
        image: ``(H, W)`` grey.
        anywhere: Whether to match more keyframes than those with the nearest viewing directions.
        detector: What finds keypoints; if its object is anywhere, any side of it may be up.
    """
    if object_map.pointless:
        return []
    region = np.ones(image.shape, bool) if view.mask is None else view.mask
    others = nearest_views(
        object_map.keyframes, view.pose, len(object_map.keyframes) if anywhere else _MAX_KEYFRAMES
    )
    keypoints = detect_turned(image, region, detector, None if anywhere else pose_arrays(view.pose)[0])
    others, scale = others[: 4 * _MAX_KEYFRAMES], pixel_scale(view)
    return poses_from_matches(object_map, camera, keypoints, others, scale)[:3]


def poses_from_matches(
    object_map: ObjectMap,
    camera: Camera,
    found: Sequence[Keypoints],
    others: Sequence[Keyframe],
    scale: float,
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from the matches with one keyframe each, most inliers first.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        found: The frame's keypoints, in one turn or in several.
        others: The keyframes.
        scale: See `pixel_scale`.
    """
    posed = []
    for keypoints, other in product(found, others):
        pairs = match(keypoints, other.keypoints)
        names = other.keypoint_landmark[pairs[:, 1]]
        sound = (names >= 0) & ~object_map.candidate[names]
        points = FollowedPoints(names[sound], keypoints.pixel[pairs[sound, 0]])
        pose = pose_of_points(object_map, camera, points, scale)
        if pose is not None:
            posed.append(pose)
    posed.sort(key=lambda one: -len(one[1]))
    return posed


# Relocalization of a lost object in the whole frame, by keypoints matched with the keyframes'.
#
# After the object has left or is occluded, a mask tracker's mask says nothing about where it reappears.

_MAX_KEYPOINTS = 1500  # most keypoints of a whole frame
_MOST_KEYFRAMES_MATCHED = 24  # most keyframes that they are matched with
_MIN_INLIERS = 10  # fewest inliers of one keyframe; matches with another object hardly ever have as many


def relocalize_in_frame(
    object_map: ObjectMap, camera: Camera, image: NDArray[np.uint8], last: Pose, detector: Detector = SIFT
) -> tuple[Pose, FollowedPoints] | None:
    """The pose with most inliers among the frame's keypoints, and the inliers; None if there are too few.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        image: ``(H, W)`` grey.
        last: A pose from before the loss; the object is searched at about its size there.
        detector: What finds keypoints.
    """
    box = projected_box(object_map.vertices, camera, last)
    if box is None or object_map.pointless or not object_map.keyframes:
        return None
    length = max(box[2], box[3])
    everywhere = np.ones(image.shape, bool)
    keypoints = detect_turned(image, everywhere, detector, length=length, most=_MAX_KEYPOINTS)
    count = len(object_map.keyframes)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MOST_KEYFRAMES_MATCHED)).round().astype(int))
    views = [object_map.keyframes[position] for position in chosen]
    found = poses_from_matches(object_map, camera, keypoints, views, max(1.0, length / 200))
    return found[0] if found and len(found[0][1]) >= _MIN_INLIERS else None


def overlaps_mask(silhouette: NDArray[np.bool_], mask: NDArray[np.bool_]) -> bool:
    """Whether a mask overlaps the relocalized object: then it counts as any other mask does."""
    return (mask_iou_or_none(silhouette, mask) or 0.0) > ELSEWHERE
