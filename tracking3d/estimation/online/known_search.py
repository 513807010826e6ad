"""A known object in a frame of which nothing is known: by keypoints anywhere in it, by its outline where a mask is."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.framing import mask_box
from tracking3d.estimation.online.belief import ObjectMap, View
from tracking3d.estimation.online.keypoints import Keypoints, detect, match
from tracking3d.estimation.online.known_views import sides
from tracking3d.estimation.online.mapping import nearest_views, project_points
from tracking3d.estimation.online.points import FollowedPoints
from tracking3d.estimation.online.pose_refinement import refine_poses
from tracking3d.estimation.online.pose_refinement_types import PoseFit, PoseWeights
from tracking3d.estimation.online.tracking import matched_poses, pose_of_points
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, from_matrix
from tracking3d.rendering import Surface

_MOST = 2000  # keypoints of a whole frame, at each size
_LENGTHS = (0.25, 0.75)  # of the frame's height, that the object may have: pictures are scaled for both
_POSES = 3  # that most keypoints agree with
_NEIGHBOURS = 6  # drawn sides whose matches are joined, once it is known which side is seen
_JOINED = 5.0  # pixels of an object 200 pixels large within which they count
_DIRECTIONS, _ROLLS = 160, 18  # that an outline is tried from
_UNLIKE = 0.4  # logarithm of two boxes' ratios of width and height that are not one outline's
_STAGES = ((120, 2), (24, 8))  # how many go on, and the steps that each then gets
_FINALISTS = 5
_VERTICES = 600  # that tell the box of an outline


def by_keypoints(
    known: ObjectMap, camera: Camera, image: NDArray[np.uint8], mask: NDArray[np.bool_] | None
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses that keypoints agree with, and those keypoints, most agreeing first.

    Args:
        known: The map.
        camera: Of the full frame.
        image: ``(H, W)`` grey.
        mask: ``(H, W)`` where the object is looked for; None for anywhere.
    """
    if mask is None:
        height = image.shape[0]
        everywhere = np.ones(image.shape, bool)
        found = [
            (detect(image, everywhere, share * height, _MOST), share * height / 200) for share in _LENGTHS
        ]
    else:
        length = max(mask_box(mask)[2:])
        reach = 2 * max(round(0.05 * length), 1) + 1
        region = cv2.dilate(mask.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0
        found = [(detect(image, region, length, _MOST // 2), length / 200)]
    posed = []
    for keypoints, size in found:
        scale = max(1.0, size)
        for pose, points in matched_poses(known, camera, keypoints, known.keyframes, scale)[:_POSES]:
            posed.append(_joined(known, camera, keypoints, pose, points, scale))
    return sorted(posed, key=lambda one: -len(one[1]))[:_POSES]


def _joined(
    known: ObjectMap, camera: Camera, keypoints: Keypoints, pose: Pose, points: FollowedPoints, scale: float
) -> tuple[Pose, FollowedPoints]:
    """The pose once more, by what all sides that are like the one seen say of the keypoints."""
    together = points
    for other in nearest_views(known.keyframes, pose, _NEIGHBOURS):
        pairs = match(keypoints, other.keypoints)
        names = other.keypoint_landmark[pairs[:, 1]]
        pairs, names = pairs[names >= 0], names[names >= 0]
        pixel = keypoints.pixel[pairs[:, 0]]
        gap = np.linalg.norm(project_points(known.landmarks[names], pose, camera) - pixel, axis=1)
        first = np.unique(names, return_index=True)[1]
        near = first[gap[first] < _JOINED * scale]
        together = together.joined(FollowedPoints(names[near], pixel[near]))
    better = pose_of_points(known, camera, together, scale)
    return (pose, points) if better is None or len(better[1]) < len(points) else better


def by_outline(surface: Surface, camera: Camera, view: View, weights: PoseWeights) -> list[Pose]:
    """The poses, all around, whose outlines and pixels fit a frame's mask best; there must be one.

    Args:
        surface: The object.
        camera: Of the full frame.
        view: The frame.
        weights: Of the kinds of evidence.
    """
    assert view.mask is not None
    poses = _placed(surface, camera, view.mask)
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


def _placed(surface: Surface, camera: Camera, mask: NDArray[np.bool_]) -> list[Pose]:
    """Rotations all around, each put where the box of its outline is the mask's; none whose box has another form."""
    left, top, width, height = mask_box(mask)
    middle = np.array([left + (width - 1) / 2 - camera.cx, top + (height - 1) / 2 - camera.cy])
    vertices = surface.vertices.double().cpu().numpy()
    vertices = vertices[:: max(len(vertices) // _VERTICES, 1)]
    turns = Rotation.from_euler("z", np.arange(_ROLLS)[:, None] * 360 / _ROLLS, degrees=True).as_matrix()
    R = (turns[None] @ np.stack(sides(_DIRECTIONS))[:, None]).reshape(-1, 3, 3)
    placed = np.einsum("nij,vj->nvi", R[:, :2], vertices)
    low, high = placed.min(1), placed.max(1)
    form = np.maximum(high - low, 1e-6)
    alike = np.abs(np.log(form[:, 0] / form[:, 1] * height / width)) < _UNLIKE
    depth = np.sqrt(camera.fx * form[:, 0] / width * camera.fy * form[:, 1] / height)[:, None]
    shift = depth * middle / [camera.fx, camera.fy] - 0.5 * (low + high)
    t = np.concatenate([shift, depth], 1)
    both = from_matrix(
        torch.from_numpy(R[alike]).to(surface.vertices), torch.from_numpy(t[alike]).to(surface.vertices)
    )
    return [both[n] for n in range(int(alike.sum()))]
