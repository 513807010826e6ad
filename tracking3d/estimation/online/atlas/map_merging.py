"""Merges two maps of one object: the second in the first's coordinates, and shared landmarks with one index."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import match
from tracking3d.estimation.online.mapping.keyframe_culling import cull_keyframes, prune_landmarks
from tracking3d.estimation.online.mapping.local_mapping import nearest_views, project_points
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_arrays, pose_from_arrays
from tracking3d.geometry.similarity import Similarity

_COMPARED_KEYFRAMES = 4  # keyframes of the first map that each of the second is compared with
_MAX_REPROJECTION_ERROR = (
    20.0  # pixels at an object size of 200 pixels, between both projections of a landmark
)

Pairs = NDArray[np.int64]
"""``(N, 2)`` indices of landmarks of the first and second map that are the same point of the object."""


def transform_map(object_map: ObjectMap, similarity: Similarity) -> ObjectMap:
    """A map in the coordinates that ``similarity`` leads to."""
    vertices = similarity.points(object_map.vertices.double().cpu().numpy())
    keyframes = [
        replace(view, pose=transform_pose(view.pose, similarity), texture=None)
        for view in object_map.keyframes
    ]
    return replace(
        object_map,
        vertices=torch.from_numpy(vertices).to(object_map.vertices),
        landmarks=similarity.points(object_map.landmarks),
        keyframes=tuple(keyframes),
        free_axis=None,  # it is found again
    )


def transform_pose(pose: Pose, similarity: Similarity) -> Pose:
    """A pose in the second map's coordinates as one in the first's."""
    R, t = pose_arrays(pose)
    T_cam_obj = np.eye(4)
    T_cam_obj[:3, :3], T_cam_obj[:3, 3] = R, t
    (T,) = similarity.poses(T_cam_obj[None])
    return pose_from_arrays(T[:3, :3], T[:3, 3], pose.translation)


def match_landmarks(first: ObjectMap, second: ObjectMap, camera: Camera) -> Pairs:
    """Shared landmarks: their keypoints match, and both maps project them to nearly the same pixel.

    Args:
        first: A map.
        second: Another map, in the coordinates of the first.
        camera: The camera of both.
    """
    votes: Counter[tuple[int, int]] = Counter()
    for view in second.keyframes:
        limit = _MAX_REPROJECTION_ERROR * max(1.0, view.observation.window.side / 200)
        for other in nearest_views(first.keyframes, view.pose, _COMPARED_KEYFRAMES):
            pairs = match(other.keypoints, view.keypoints)
            a, b = other.keypoint_landmark[pairs[:, 0]], view.keypoint_landmark[pairs[:, 1]]
            known = (a >= 0) & (b >= 0)
            a, b, pairs = a[known], b[known], pairs[known]
            sound = ~first.candidate[a] & ~second.candidate[b] & np.isfinite(first.landmarks[a]).all(1)
            a, b, pairs = a[sound], b[sound], pairs[sound]
            place = project_points(first.landmarks[a], view.pose, camera)
            near = np.linalg.norm(place - view.keypoints.pixel[pairs[:, 1]], axis=1) < limit
            votes.update(zip(a[near].tolist(), b[near].tolist(), strict=True))
    pairs_found, taken_first, taken_second = [], set[int](), set[int]()
    for (one, two), _ in votes.most_common():
        if one not in taken_first and two not in taken_second:
            pairs_found.append((one, two))
            taken_first.add(one)
            taken_second.add(two)
    return np.array(pairs_found, np.int64).reshape(-1, 2)


def merge(first: ObjectMap, second: ObjectMap, pairs: Pairs, most: int) -> ObjectMap:
    """The keyframes and landmarks of both maps, on the first map's surface.

    Args:
        first: A map.
        second: Another map, in the coordinates of the first, with features of the same kind.
        pairs: See `match_landmarks`.
        most: The most keyframes that are kept.
    """
    names = len(first.landmarks) + np.arange(len(second.landmarks))
    names[pairs[:, 1]] = pairs[:, 0]
    there = {view.index for view in first.keyframes}
    added = [_relabel(view, names) for view in second.keyframes if view.index not in there]
    keyframes = sorted((*first.keyframes, *added), key=lambda view: view.index)
    object_map = replace(
        first,
        landmarks=np.concatenate([first.landmarks, second.landmarks]),
        candidate=np.concatenate([first.candidate, second.candidate]),
        keyframes=tuple(replace(view, is_adjusted=False) for view in cull_keyframes(tuple(keyframes), most)),
        asked_landmarks=-1,
        pointless=first.pointless and second.pointless,
        free_axis=None,
        started_at_rest=first.started_at_rest or second.started_at_rest,
    )
    return prune_landmarks(object_map, FollowedPoints.none())[0]


def _relabel(view: Keyframe, names: NDArray[np.int64]) -> Keyframe:
    """A view with renumbered landmarks; of two that are now the same landmark, the first is kept."""
    landmark, first = np.unique(names[view.points.landmark], return_index=True)
    points = FollowedPoints(landmark, view.points.pixel[first])
    label = np.where(view.keypoint_landmark >= 0, names[view.keypoint_landmark], -1)
    return replace(view, points=points, keypoint_landmark=label)
