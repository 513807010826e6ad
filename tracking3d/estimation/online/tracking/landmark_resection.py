"""The pose of one frame by landmarks that are followed densely from the nearest keyframes.

A pose that was fitted to pixels and outlines takes over what the surface and the mask are wrong by. Patches of the
keyframes, warped through the surface, do not.
"""

from __future__ import annotations

import math

from tracking3d.estimation.online.mapping.keyframe_views import draw_keyframe, draw_keyframes
from tracking3d.estimation.online.mapping.local_mapping import nearest_views
from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose, pose_from_arrays, rotation_angle
from tracking3d.points.resection import resect

_NEAREST = 2
"""Keyframes that are looked at; with four of them poses were no better."""
_MIN_AGREEING, _MIN_SHARE = 20, 0.7
"""Landmarks that have to agree with a pose, and their share of all that begin in those keyframes."""
_MAX_TURN = math.radians(2.5)
"""By which a pose is corrected at most. On cube_in_hand, where a new side turns into view and the surface is wrong, the
landmarks of the side before moved poses by 3 to 18 degrees, and were wrong."""


def resect_pose(object_map: ObjectMap, camera: Camera, view: Keyframe, pose: Pose) -> Pose:
    """A frame's pose, corrected by dense landmarks; as it is if too few of them agree.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        view: The frame.
        pose: Where the object is about.
    """
    drawn = draw_keyframe(object_map, camera, view, pose)
    if drawn is None:
        return pose
    near = {other.index for other in nearest_views(object_map.keyframes, pose, _NEAREST)}
    positions = [place for place, other in enumerate(object_map.keyframes) if other.index in near]
    scene = draw_keyframes(object_map, camera, positions)
    known = [position for position in positions if scene.views[position] is not None]
    resected, share = resect(scene, drawn, known)
    begun = sum(len(scene.seeds_of(position)[2]) for position in known)
    if share < _MIN_SHARE or share * begun < _MIN_AGREEING:
        return pose
    T = resected.T_cam_obj
    corrected = pose_from_arrays(T[:3, :3], T[:3, 3], object_map.vertices)
    turn = float(rotation_angle(corrected.quaternion, pose.quaternion))
    return corrected if turn < _MAX_TURN else pose
