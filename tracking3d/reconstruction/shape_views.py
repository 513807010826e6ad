"""The frames that a shape is made from: from all sides that were seen, and some that are kept to judge it by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera, Window
from tracking3d.points.outline_fit import depth_inside
from tracking3d.scene.view import crop_window, inside_frame
from tracking3d.trackers.crops import box_of

SIDE = 192
"""Pixels of a view's side; a smaller window is seen larger."""
_MARGIN = 0.08  # around the mask, relative to its longer side


@dataclass(frozen=True, eq=False)
class ShapeView:
    """A frame with a reliable pose and mask, cut out around the object."""

    index: int  # index of the frame
    image: NDArray[np.uint8]  # (S, S, 3) uint8 RGB
    depth_inside: NDArray[np.float32]  # (S, S) float32, pixels from the mask's outline, positive inside
    # (4,) left, right, top and bottom edge of the frame in the window's pixels; beyond them nothing is known
    within: NDArray[np.float32]
    K: NDArray[np.float64]  # (3, 3) intrinsics of the window
    T_cam_obj: NDArray[np.float64]  # (4, 4)

    @property
    def mask(self) -> NDArray[np.bool_]:
        """``(S, S)`` the object."""
        return self.depth_inside > 0

    @property
    def in_frame(self) -> NDArray[np.bool_]:
        """``(S, S)`` the pixels of the window that the frame has."""
        left, right, top, bottom = self.within
        place = np.arange(len(self.mask))
        return ((place >= top) & (place <= bottom))[:, None] & ((place >= left) & (place <= right))

    @property
    def P(self) -> NDArray[np.float64]:
        """``(3, 4)`` from object coordinates to pixels of the window, times the depth."""
        return np.asarray(self.K @ self.T_cam_obj[:3])


def shape_view(
    index: int,
    image: Image,
    mask: NDArray[np.bool_],
    camera: Camera,
    T_cam_obj: NDArray[np.float64],
    side: int = SIDE,
) -> ShapeView | None:
    """A frame as a shape is made from it; None if its mask is empty.

    Args:
        index: Index of the frame.
        image: ``(H, W, 3)`` RGB.
        mask: ``(H, W)`` the object.
        camera: Camera of the full frame.
        T_cam_obj: ``(4, 4)``.
        side: Pixels of the view's side.
    """
    box = box_of(mask)
    if box is None:
        return None
    window = Window.around(box, _MARGIN, side)
    inside = (crop_window(mask, window) > 0.5) & inside_frame(mask.shape, window)
    if not inside.any():
        return None
    height, width = mask.shape
    edges = np.array([-window.left, width - window.left, -window.top, height - window.top]) * window.scale
    return ShapeView(
        index,
        crop_window(image, window),
        depth_inside(inside),
        (edges - 0.5).astype(np.float32),
        window.K(camera),
        np.array(T_cam_obj, np.float64),
    )


def spread_by_rotation(views: Sequence[ShapeView], degrees: float, most: int) -> list[ShapeView]:
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
