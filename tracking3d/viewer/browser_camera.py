"""Where the browser looks at the scene from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from tracking3d.viewer.scene import ObjectScene


def look_from_aside(server: viser.ViserServer, scenes: Sequence[ObjectScene]) -> None:
    """Where a browser looks from at first: from the side and a little above, at objects and paths together."""
    first, last = scenes[0], scenes[-1]
    row = last.place - first.place
    to_path = first.middle_of_path
    aside = np.cross(to_path, [0.0, 1.0, 0.0])
    aside = aside / max(float(np.linalg.norm(aside)), 1e-9)
    reach = first.distance + 0.7 * float(np.linalg.norm(row))
    camera = server.initial_camera
    camera.look_at = 0.45 * to_path + row / 2
    camera.position = camera.look_at + 0.5 * to_path + reach * (2.2 * aside - [0.0, 0.8, 0.0])
    camera.fov = 0.8


def look_through(server: viser.ViserServer, T_world_cam: NDArray[np.floating], fov: float) -> None:
    """Let every browser look where a camera stands.

    Args:
        server: Serves the browsers.
        T_world_cam: ``(4, 4)`` from the camera to the scene.
        fov: Its vertical field of view in degrees.
    """
    rotation = viser.transforms.SO3.from_matrix(T_world_cam[:3, :3])
    for client in server.get_clients().values():
        with client.atomic():
            client.camera.position, client.camera.wxyz = T_world_cam[:3, 3], rotation.wxyz
            client.camera.fov = np.radians(fov)
