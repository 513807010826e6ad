"""Keyframes as views of the map's surface, in which dense landmarks are followed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.online.state.object_map import Keyframe, ObjectMap
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose
from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.points.view import LANDMARK_WINDOW, GreyWindow, SurfaceView, cut_window, draw_into_window


def cut_around_object(
    object_map: ObjectMap,
    camera: Camera,
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_] | None,
    pose: Pose,
) -> GreyWindow | None:
    """The window of a frame in which landmarks are followed; None if there is nothing to be followed.

    Args:
        object_map: The map.
        camera: The camera of the full frame.
        image: ``(H, W, 3)`` the frame.
        mask: ``(H, W)`` of the object.
        pose: Where the object is about.
    """
    if mask is None or object_map.pointless or object_map.fixed_keyframes:
        return None
    vertices = object_map.landmark_scene.vertices
    return cut_window(image, mask, camera, pose.matrix().numpy(), vertices, LANDMARK_WINDOW)


def draw_keyframe(object_map: ObjectMap, camera: Camera, view: Keyframe, pose: Pose) -> SurfaceView | None:
    """A keyframe, or a frame that may become one, with the map's surface drawn at a pose; None if it has no window."""
    if view.image is None:
        return None
    scene = object_map.landmark_scene
    return draw_into_window(view.image, camera, pose.matrix().numpy(), scene.vertices, scene.faces)


def draw_keyframes(object_map: ObjectMap, camera: Camera, positions: list[int]) -> LandmarkScene:
    """The map's scene with keyframes drawn at these positions, as far as they have windows."""
    scene = object_map.landmark_scene
    for position in positions:
        if scene.views[position] is None:
            view = object_map.keyframes[position]
            scene.views[position] = draw_keyframe(object_map, camera, view, view.pose)
    return scene
