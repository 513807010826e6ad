"""The camera of the browser's 3D view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from tracking3d.viewer.scene import ObjectScene

_FOV = 0.8  # radians, upright
_ASPECT = 0.6  # width through height of what the panels leave of a usual window
_NARROW = 0.38  # the same if videos are side by side, and their panel is wider
_TILT = 0.5  # of the look onto a path's plane, so that it is seen from aside, too
_BEHIND = 1.5  # of the look from where the cameras are, so that the sides that they saw are seen
_MARGIN = 1.15


def look_from_aside(server: viser.ViserServer, scenes: Sequence[ObjectScene], narrow: bool = False) -> None:
    """Where a browser looks from at first: from behind the camera's path and aside, at objects and paths together.

    Browsers that are open stay where they are; their button that resets the view takes them there.

    Args:
        server: Serves the browsers.
        scenes: What is to be in view.
        narrow: Whether the panel is wide, since it shows several videos, and leaves a narrow view.
    """
    aside = aside_of(scenes[0].path)
    places = np.concatenate([scene.place + np.vstack([scene.path, np.zeros(3)]) for scene in scenes])
    camera = server.initial_camera
    camera.look_at, distance = frame_object(places, aside, _NARROW if narrow else _ASPECT)
    camera.position = camera.look_at + distance * aside
    camera.fov = _FOV


def frame_object(
    places: NDArray[np.float64], aside: NDArray[np.float64], aspect: float = _ASPECT
) -> tuple[NDArray[np.float64], float]:
    """Where to look, and from how far, so that all ``places`` are in view.

    Args:
        places: ``(N, 3)``.
        aside: ``(3,)`` of length 1, from where to look.
        aspect: Width of the view through its height.
    """
    right = np.cross([0.0, 1.0, 0.0], aside)
    right = right / np.linalg.norm(right) if np.linalg.norm(right) > 1e-6 else np.array([1.0, 0.0, 0.0])
    axes = np.stack([right, np.cross(aside, right), aside])
    seen = places @ axes.T
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    across, upright = _MARGIN * np.abs(seen - middle)[:, :2].T
    towards = (seen - middle)[:, 2]
    half = np.tan(_FOV / 2)
    return middle @ axes, float(np.max(np.maximum(across / (half * aspect), upright / half) + towards))


def aside_of(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """A direction ``(3,)`` of length 1 from which a path ``(N, 3)`` around the origin is seen well.

    It is the normal of the plane that holds path and object, from above (y points down), tilted, and turned towards
    where the cameras are, for what they never saw is a guess. A path of next to no length has many such planes: of
    them it is the one that stands upright.
    """
    middle = 0.5 * path.mean(axis=0)
    onto = path - middle
    # A little of the plane that is upright: what the path does not say is said by that.
    upright = 0.05 * float(np.abs(path).max()) * np.array([0.0, 1.0, 0.0])
    places = np.concatenate([onto, [-middle, upright, -upright]])
    normal = np.linalg.svd(places, full_matrices=False)[2][2]
    normal = -normal if normal[1] > 0 else normal
    above = np.array([0.0, -1.0, 0.0]) if abs(normal[1]) < 0.7 else np.zeros(3)
    tilted = normal + _TILT * above + _BEHIND * _mean_direction(path)
    direction: NDArray[np.float64] = tilted / np.linalg.norm(tilted)
    return direction


def _mean_direction(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean direction of the cameras from the object; short if they are all around it."""
    directions = path / np.maximum(np.linalg.norm(path, axis=1, keepdims=True), 1e-9)
    mean = directions.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.2 else 0.25 * directions[0]


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
