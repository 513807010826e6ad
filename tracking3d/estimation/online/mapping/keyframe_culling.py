"""Bounds the map: a maximum number of keyframes, and only landmarks that are still referenced."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.features.klt import FollowedPoints
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.pose import rotation_angle


def cull_keyframes(keyframes: tuple[Keyframe, ...], most: int) -> tuple[Keyframe, ...]:
    """At most ``most`` keyframes: the later of the two most similar older ones goes; the first and recent half stay."""
    kept = list(keyframes)
    while len(kept) > most:
        older = kept[: max(len(kept) - most // 2, 2)]
        # Compared with later ones, each would go as it leaves the recent half, and none between would be kept.
        gaps = [
            min(
                float(rotation_angle(older[place].pose.quaternion, other.pose.quaternion))
                for other in older[:place]
            )
            for place in range(1, len(older))
        ]
        kept.pop(1 + int(np.argmin(gaps)))
    return tuple(kept)


def prune_landmarks(object_map: ObjectMap, followed: FollowedPoints) -> tuple[ObjectMap, FollowedPoints]:
    """The map without landmarks that no keyframe shows and no tracked point belongs to; the rest are renumbered."""
    used = np.zeros(len(object_map.landmarks), bool)
    used[followed.landmark] = True
    for view in object_map.keyframes:
        used[view.points.landmark] = True
        used[view.keypoint_landmark[view.keypoint_landmark >= 0]] = True
    number = np.cumsum(used) - 1

    def renamed(points: FollowedPoints) -> FollowedPoints:
        return FollowedPoints(number[points.landmark], points.pixel)

    def relabelled(label: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.where(label >= 0, number[label], -1)

    keyframes = tuple(
        replace(view, points=renamed(view.points), keypoint_landmark=relabelled(view.keypoint_landmark))
        for view in object_map.keyframes
    )
    object_map = replace(
        object_map,
        landmarks=object_map.landmarks[used],
        candidate=object_map.candidate[used],
        keyframes=keyframes,
    )
    return object_map, renamed(followed)
