"""Where the browser looks at the scene from."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from tracking3d.viewer.scene import ObjectScene

_FOV = 0.8  # radians
_TILT = 0.5  # of the look onto a path's plane, so that it is seen from aside, too
_AWAY = 3.7  # distances between object and camera, so that both are in view


def look_from_aside(server: viser.ViserServer, scenes: Sequence[ObjectScene]) -> None:
    """Where a browser looks from at first: onto the plane of the camera's path, at objects and paths together."""
    row = scenes[-1].place - scenes[0].place
    aside, middle = aside_of(scenes[0].path)
    camera = server.initial_camera
    camera.look_at = middle + row / 2
    reach = scenes[0].distance + 0.4 * float(np.linalg.norm(row))
    camera.position = camera.look_at + _AWAY * reach * aside
    camera.fov = _FOV


def aside_of(path: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A direction ``(3,)`` of length 1 from which a path ``(N, 3)`` around the origin is seen well, and its middle.

    It is the normal of the plane that holds path and object, from above (y points down) and tilted. A path of next
    to no length has many such planes: of them it is the one that stands upright.
    """
    middle = 0.5 * path.mean(axis=0)
    onto = path - middle
    # A little of the plane that is upright: what the path does not say is said by that.
    upright = 0.05 * float(np.abs(path).max()) * np.array([0.0, 1.0, 0.0])
    normal = np.linalg.svd(np.concatenate([onto, [-middle, upright, -upright]]))[2][2]
    normal = -normal if normal[1] > 0 else normal
    tilted = normal + _TILT * (np.array([0.0, -1.0, 0.0]) if abs(normal[1]) < 0.7 else _towards(path))
    return tilted / np.linalg.norm(tilted), middle


def _towards(path: NDArray[np.float64]) -> NDArray[np.float64]:
    return path[0] / max(float(np.linalg.norm(path[0])), 1e-9)


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
