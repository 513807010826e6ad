"""Relocalization of a lost object in the whole frame, by keypoints matched with the keyframes'.

After the object has left or is occluded, a mask tracker's mask says nothing about where it reappears.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.observation import projected_box
from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.features.sift import detect
from tracking3d.estimation.online.relocalization.keypoint_matching import poses_from_matches
from tracking3d.estimation.online.state.object_map import ObjectMap
from tracking3d.estimation.tracker_feedback import ELSEWHERE
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose

_MAX_KEYPOINTS = 1500  # most keypoints of a whole frame
_MAX_KEYFRAMES = 24  # most keyframes that they are matched with
_MIN_INLIERS = 10  # fewest inliers of one keyframe; matches with another object hardly ever have as many


def relocalize_in_frame(
    object_map: ObjectMap, camera: Camera, image: NDArray[np.uint8], last: Pose
) -> tuple[Pose, FollowedPoints] | None:
    """The pose with most inliers among the frame's keypoints, and the inliers; None if there are too few.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        image: ``(H, W)`` grey.
        last: A pose from before the loss; the object is searched at about its size there.
    """
    box = projected_box(object_map.vertices, camera, last)
    if box is None or not object_map.keyframes:
        return None
    length = max(box[2], box[3])
    keypoints = detect(image, np.ones(image.shape, bool), length=length, most=_MAX_KEYPOINTS)
    count = len(object_map.keyframes)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _MAX_KEYFRAMES)).round().astype(int))
    views = [object_map.keyframes[position] for position in chosen]
    found = poses_from_matches(object_map, camera, keypoints, views, max(1.0, length / 200))
    return found[0] if found and len(found[0][1]) >= _MIN_INLIERS else None


def overlaps_mask(silhouette: NDArray[np.bool_], mask: NDArray[np.bool_]) -> bool:
    """Whether a mask overlaps the relocalized object: then it counts as any other mask does."""
    either = int(np.count_nonzero(silhouette | mask))
    return int(np.count_nonzero(silhouette & mask)) > ELSEWHERE * either
