"""What the 3D view shows at first: numbers only, so that none of it needs viser.

The object fills the view. Cameras lie many times its size away, so a view that held all of them would show it small.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.results.drawing import Colour
from tracking3d.results.overlay import ObjectAxes

FOV = 0.8
"""Upright field of view of the browser's camera in radians."""
ASPECT = 0.6
"""Width through height of what the panels leave of a usual window."""
NARROW = 0.38
"""The same if videos are side by side, and their panel is wider."""
_TILT = 0.5  # tangent of the angle between the look at first and that of the cameras
_ONE_SIDE = 0.2  # length of the mean of the cameras' directions above which they are on one side
_MARGIN = 1.25
_UNKNOWN = 0.2  # radius of an object of which neither mesh nor mask is there, of its distance
_FRUSTUM = 0.15  # size of a keyframe's frustum, in radii of the object
_FARTHEST = 0.05  # the most that it may be, of the distance between camera and object
_FAINT = 0.45  # share of its colour that is left of a frustum or the path
_NIGHT = 20  # grey value of the browser's background


def object_box(model: ObjectModel | None, axes: ObjectAxes | None, distance: float) -> NDArray[np.float64]:
    """Two opposite corners ``(2, 3)`` of the object, in object coordinates.

    Args:
        model: Its mesh; None if there is none yet.
        axes: Its middle and radius, as a mask shows them; None if there is none.
        distance: From the camera to the object.
    """
    if model is not None and len(model.vertices):
        return np.stack([model.vertices.min(axis=0), model.vertices.max(axis=0)])
    middle, radius = (np.zeros(3), _UNKNOWN * distance) if axes is None else (axes.origin, axes.length)
    return middle + radius * np.array([[-1.0], [1.0]])


def radius_of(box: NDArray[np.float64]) -> float:
    """Half the diagonal of a box ``(2, 3)``."""
    return float(np.linalg.norm(box[1] - box[0])) / 2


def corners_of(box: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corners ``(8, 3)`` of a box ``(2, 3)``."""
    return np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)


def frustum_size(radius: float, distance: float) -> float:
    """The size of a keyframe's frustum: small compared with the object.

    Args:
        radius: Of the object.
        distance: From the camera to the object.
    """
    return min(_FRUSTUM * radius, _FARTHEST * distance)


def fainten(colour: Colour) -> Colour:
    """A colour on its way to the background."""
    red, green, blue = (round(_FAINT * value + (1 - _FAINT) * _NIGHT) for value in colour)
    return red, green, blue


def stack_objects(radii: Sequence[float]) -> list[float]:
    """How far below the first each object stands, so that none touches another.

    Args:
        radii: Their radii; the scales of objects have nothing to do with one another.
    """
    places = [0.0]
    for above, radius in pairwise(radii):
        places.append(places[-1] + 1.3 * (above + radius))
    return places[: len(radii)]


def frame_object(
    places: NDArray[np.float64], aside: NDArray[np.float64], aspect: float = ASPECT
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
    half = np.tan(FOV / 2)
    return middle @ axes, float(np.max(np.maximum(across / (half * aspect), upright / half) + towards))


def aside_of(path: NDArray[np.float64]) -> NDArray[np.float64]:
    """A direction ``(3,)`` of length 1 from which to look at the object: as the cameras saw it, but from aside.

    What they never saw is a guess, so the look is from where they are in the mean, or the first one if they are all
    around the object. It is turned from there out of the plane that holds object and path, and upwards (y points down).

    Args:
        path: ``(N, 3)`` the cameras' places around the object.
    """
    directions = path / np.maximum(np.linalg.norm(path, axis=1, keepdims=True), 1e-9)
    mean = directions.mean(axis=0)
    length = float(np.linalg.norm(mean))
    seen_from = mean / length if length > _ONE_SIDE else directions[0]
    normal = np.linalg.svd(np.concatenate([path - path.mean(axis=0), path[:1]]), full_matrices=False)[2][-1]
    aside = (-normal if normal[1] > 0 else normal) + np.array([0.0, -1.0, 0.0])
    aside = aside - (aside @ seen_from) * seen_from
    if np.linalg.norm(aside) < 0.1:  # the camera looks straight down
        aside = np.array([1.0, 0.0, 0.0]) - seen_from[0] * seen_from
    tilted = seen_from + _TILT * aside / np.linalg.norm(aside)
    direction: NDArray[np.float64] = tilted / np.linalg.norm(tilted)
    return direction
