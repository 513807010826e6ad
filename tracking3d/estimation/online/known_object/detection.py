"""Detects a known object in a frame: by keypoints anywhere in it, or by its outline if there is a mask."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.observation import mask_box
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints, detect, match
from tracking3d.estimation.online.known_object.rendered_keyframes import sides
from tracking3d.estimation.online.mapping.local_mapping import nearest_views, project_points
from tracking3d.estimation.online.optimization.pose_refinement import refine_poses
from tracking3d.estimation.online.optimization.types import PoseFit, PoseWeights
from tracking3d.estimation.online.relocalization.keypoint_matching import poses_from_matches
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.tracking.pose_tracking import pose_of_points
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix
from tracking3d.rendering import Surface

_MAX_KEYPOINTS = 2000  # keypoints of a whole frame, at each size
_LENGTHS = (0.25, 0.75)  # of the frame's height, that the object may have: pictures are scaled for both
_MAX_POSES = 3  # that most keypoints agree with
_MAX_COMBINED = 6  # rendered sides whose matches are combined, once it is known which side is seen
_MAX_REPROJECTION_ERROR = 5.0  # pixels of an object 200 pixels large within which they count
_DIRECTIONS, _ROLLS = 160, 18  # that an outline is tried from
_MAX_ASPECT_DIFFERENCE = 0.4  # logarithm of two boxes' ratios of width and height that are not one outline's
_STAGES = ((120, 2), (24, 8))  # how many go on, and the steps that each then gets
_FINALISTS = 5
_VERTICES = 600  # that tell the box of an outline


def by_keypoints(
    object_map: ObjectMap, camera: Camera, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from keypoint matches, and their inliers, most inliers first.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` the region that is searched; None for the whole frame.
    """
    if mask is None:
        height = image.shape[0]
        everywhere = np.ones(image.shape, bool)
        found = [
            (detect(image, everywhere, share * height, _MAX_KEYPOINTS), share * height / 200)
            for share in _LENGTHS
        ]
    else:
        length = max(mask_box(mask)[2:])
        reach = 2 * max(round(0.05 * length), 1) + 1
        region = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
        found = [(detect(image, region, length, _MAX_KEYPOINTS // 2), length / 200)]
    posed = []
    for keypoints, size in found:
        scale = max(1.0, size)
        for pose, points in poses_from_matches(object_map, camera, keypoints, object_map.keyframes, scale)[
            :_MAX_POSES
        ]:
            posed.append(_combine_matches(object_map, camera, keypoints, pose, points, scale))
    return sorted(posed, key=lambda one: -len(one[1]))[:_MAX_POSES]


def _combine_matches(
    object_map: ObjectMap,
    camera: Camera,
    keypoints: Keypoints,
    pose: Pose,
    points: FollowedPoints,
    scale: float,
) -> tuple[Pose, FollowedPoints]:
    """The pose again, from the matches with all sides near the one seen."""
    together = points
    for other in nearest_views(object_map.keyframes, pose, _MAX_COMBINED):
        pairs = match(keypoints, other.keypoints)
        names = other.keypoint_landmark[pairs[:, 1]]
        pairs, names = pairs[names >= 0], names[names >= 0]
        pixel = keypoints.pixel[pairs[:, 0]]
        gap = np.linalg.norm(project_points(object_map.landmarks[names], pose, camera) - pixel, axis=1)
        first = np.unique(names, return_index=True)[1]
        near = first[gap[first] < _MAX_REPROJECTION_ERROR * scale]
        together = together.concatenate(FollowedPoints(names[near], pixel[near]))
    better = pose_of_points(object_map, camera, together, scale)
    return (pose, points) if better is None or len(better[1]) < len(points) else better


def by_outline(surface: Surface, camera: Camera, view: Keyframe, weights: PoseWeights) -> list[Pose]:
    """The poses, among all rotations, whose outlines and pixels fit a frame's mask best; at least one.

    Args:
        surface: The object.
        camera: The camera of the full frame.
        view: The frame.
        weights: The weights of the kinds of evidence.
    """
    assert view.mask is not None
    poses = _align_candidates(surface, camera, view.mask)
    small = view.observation.half
    fits = refine_poses(surface, small, poses, None, weights, (0,))
    for survivors, steps in _STAGES:
        fits.sort(key=_cost)
        best = [fit.pose for fit in fits[:survivors]]
        fits = refine_poses(surface, small, best, None, weights, (steps,))
    fits.sort(key=_cost)
    return [fit.pose for fit in fits[:_FINALISTS]]


def _cost(fit: PoseFit) -> float:
    total = fit.cost + 1 - fit.overlap
    return total if math.isfinite(total) else math.inf


def _align_candidates(surface: Surface, camera: Camera, mask: NDArray[np.bool_]) -> list[Pose]:
    """Rotations all around, each aligned by its outline's box with the mask's; none whose aspect ratio differs."""
    left, top, width, height = mask_box(mask)
    middle = np.array([left + (width - 1) / 2 - camera.cx, top + (height - 1) / 2 - camera.cy])
    vertices = surface.vertices.double().cpu().numpy()
    vertices = vertices[:: max(len(vertices) // _VERTICES, 1)]
    turns = Rotation.from_euler("z", np.arange(_ROLLS)[:, None] * 360 / _ROLLS, degrees=True).as_matrix()
    R = (turns[None] @ np.stack(sides(_DIRECTIONS))[:, None]).reshape(-1, 3, 3)
    placed = np.einsum("nij,vj->nvi", R[:, :2], vertices)
    low, high = placed.min(1), placed.max(1)
    form = np.maximum(high - low, 1e-6)
    alike = np.abs(np.log(form[:, 0] / form[:, 1] * height / width)) < _MAX_ASPECT_DIFFERENCE
    depth = np.sqrt(camera.fx * form[:, 0] / width * camera.fy * form[:, 1] / height)[:, None]
    shift = depth * middle / [camera.fx, camera.fy] - 0.5 * (low + high)
    t = np.concatenate([shift, depth], 1)
    both = from_matrix(
        torch.from_numpy(R[alike]).to(surface.vertices), torch.from_numpy(t[alike]).to(surface.vertices)
    )
    return [both[n] for n in range(int(alike.sum()))]
