"""The camera of the browser's 3D view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from tracking3d.viewer.first_look import ASPECT, FOV, NARROW, aside_of, corners_of, frame_object
from tracking3d.viewer.scene import ObjectScene


def look_from_aside(server: viser.ViserServer, scenes: Sequence[ObjectScene], narrow: bool = False) -> None:
    """Where a browser looks from at first: as the cameras saw the objects, but from aside, and so near that
    they fill the view.

    Browsers that are open stay where they are; their button that resets the view takes them there.

    Args:
        server: Serves the browsers.
        scenes: What is to be in view.
        narrow: Whether the panel is wide, since it shows several videos, and leaves a narrow view.
    """
    aside = aside_of(scenes[0].path)
    places = np.concatenate([scene.place + corners_of(scene.box) for scene in scenes])
    camera = server.initial_camera
    camera.look_at, distance = frame_object(places, aside, NARROW if narrow else ASPECT)
    camera.position = camera.look_at + distance * aside
    camera.fov = FOV


def look_through(
    server: viser.ViserServer, T_world_cam: NDArray[np.floating], fov: float, aspect: float
) -> None:
    """Move every browser's view to a camera, with its whole field of view.

    Args:
        server: Serves the browsers.
        T_world_cam: ``(4, 4)`` from the camera to the scene.
        fov: Its vertical field of view in degrees.
        aspect: Width of its picture through its height.
    """
    rotation = viser.transforms.SO3.from_matrix(T_world_cam[:3, :3])
    for client in server.get_clients().values():
        with client.atomic():
            client.camera.position, client.camera.wxyz = T_world_cam[:3, 3], rotation.wxyz
            wider = max(1.0, aspect / client.camera.aspect)  # what the panels leave may be narrow
            client.camera.fov = float(2 * np.arctan(wider * np.tan(np.radians(fov) / 2)))
