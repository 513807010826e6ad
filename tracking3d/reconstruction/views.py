"""The frames that texture and shape are taken from: from all sides that were seen, for a texture few and sharp."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tracking3d.geometry.camera import Window
from tracking3d.scene.view import ObjectView
from tracking3d.trackers.crops import box_of

SIDE = 192
"""Pixels of the side of a view that a shape is made from; a smaller window is seen larger."""
_LARGEST = 640  # pixels of the side of a view that a texture is taken from; a larger window is seen smaller
_MOSTLY_SHOWN = 0.8  # share of another such view's area from which nothing hides the object (chosen)
_MARGIN, _TEXTURE_MARGIN = 0.08, 0.05  # around the mask, relative to its longer side


def texture_view(frame: ObjectView) -> ObjectView | None:
    """A whole frame as a texture is taken from it; None if its mask is empty or too small to have an inside."""
    box = box_of(frame.mask)
    if box is None:
        return None
    view = frame.at(Window.around(box, _TEXTURE_MARGIN, _LARGEST, enlarge=False))
    return view if view.interior.any() else None


def shape_view(frame: ObjectView, side: int = SIDE) -> ObjectView | None:
    """A whole frame as a shape is made from it, ``side`` pixels wide; None if its mask is empty."""
    box = box_of(frame.mask)
    if box is None:
        return None
    view = frame.at(Window.around(box, _MARGIN, side))
    return view if view.mask.any() else None


def keep_best_views(views: tuple[ObjectView, ...], view: ObjectView, most: int) -> tuple[ObjectView, ...]:
    """The views with one more; of more than ``most`` one of the two that see most alike goes.

    That is the one that shows clearly less, since something hides the object, or else the less sharp one.
    """
    if most < 1:
        return ()
    views = (*views, view)
    if len(views) <= most:
        return views
    directions = np.stack([one.direction for one in views])
    likeness = np.triu(directions @ directions.T, 1) - 2 * np.tri(len(views))
    pair = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
    areas = {int(place): _shown_area(views[place]) for place in pair}
    dropped = min(areas, key=areas.__getitem__)
    if areas[dropped] >= _MOSTLY_SHOWN * max(areas.values()):
        dropped = min(areas, key=lambda place: (views[place].sharpness, -place))
    return (*views[:dropped], *views[dropped + 1 :])


def _shown_area(view: ObjectView) -> float:
    """The mask's area at the object's distance, in units of the object squared."""
    return float(np.count_nonzero(view.mask) * view.T_cam_obj[2, 3] ** 2 / (view.K[0, 0] * view.K[1, 1]))


def spread_by_rotation(views: Sequence[ObjectView], degrees: float, most: int) -> list[ObjectView]:
    """Those views that differ by at least ``degrees`` from all chosen before; by more, if they are too many."""
    rotations = np.stack([view.T_cam_obj[:3, :3] for view in views]) if views else np.zeros((0, 3, 3))
    while True:
        chosen: list[int] = []
        nearest = 1 + 2 * np.cos(np.radians(degrees))  # trace of a rotation by that angle
        for n, rotation in enumerate(rotations):
            traces = np.einsum("nij,ij->n", rotations[chosen], rotation)
            if not len(traces) or traces.max() <= nearest:
                chosen.append(n)
        if len(chosen) <= most:
            return [views[n] for n in chosen]
        degrees = max(1.2 * degrees, 0.1)
