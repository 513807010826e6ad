"""A pose from keypoints that match those of keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import Keypoints, detect, match
from tracking3d.estimation.online.mapping.local_mapping import (
    nearest_views,
)
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.estimation.online.tracking.pose_tracking import pixel_scale, pose_of_points
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose

_MAX_KEYFRAMES = 6  # most keyframes that a doubtful frame is matched with


def match_keyframes(
    object_map: ObjectMap, camera: Camera, view: Keyframe, image: NDArray[np.uint8], anywhere: bool
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from keypoints matched with keyframes, most inliers first.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        view: The frame, with the best pose so far.
        image: ``(H, W)`` grey.
        anywhere: Whether to match more keyframes than those with the nearest viewing directions.
    """
    region = np.ones(image.shape, bool) if view.mask is None else view.mask
    others = nearest_views(
        object_map.keyframes, view.pose, len(object_map.keyframes) if anywhere else _MAX_KEYFRAMES
    )
    keypoints = detect(image, region)
    return poses_from_matches(object_map, camera, keypoints, others[: 4 * _MAX_KEYFRAMES], pixel_scale(view))[
        :3
    ]


def poses_from_matches(
    object_map: ObjectMap, camera: Camera, keypoints: Keypoints, others: Sequence[Keyframe], scale: float
) -> list[tuple[Pose, FollowedPoints]]:
    """Poses from the matches with one keyframe each, most inliers first.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        keypoints: The frame's keypoints.
        others: The keyframes.
        scale: See `pixel_scale`.
    """
    found = []
    for other in others:
        pairs = match(keypoints, other.keypoints)
        names = other.keypoint_landmark[pairs[:, 1]]
        sound = (names >= 0) & ~object_map.candidate[names]
        points = FollowedPoints(names[sound], keypoints.pixel[pairs[sound, 0]])
        pose = pose_of_points(object_map, camera, points, scale)
        if pose is not None:
            found.append(pose)
    found.sort(key=lambda one: -len(one[1]))
    return found
