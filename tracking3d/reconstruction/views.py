"""The frames that a texture is taken from: few, sharp, and from all sides that were seen."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera, Window
from tracking3d.scene.view import crop_window, inside_frame
from tracking3d.trackers.crops import box_of

_MARGIN = 0.05  # around the mask, relative to its longer side
_LARGEST = 640  # pixels of a view's side; a larger window is seen smaller
_OUTLINE = (1.5, 4.5)
"""Pixels within the outline up to which, and from which on, colours are the background's and the object's."""


@dataclass(frozen=True, eq=False)
class TextureView:
    """A frame with a reliable pose, cut out around the object."""

    index: int  # index of the frame
    image: NDArray[np.uint8]  # (S, S, 3) uint8 RGB
    valid: NDArray[np.float32]  # (S, S) float32 in [0, 1], how far each pixel is surely the object's
    K: NDArray[np.float64]  # (3, 3) intrinsics of the window
    T_cam_obj: NDArray[np.float64]  # (4, 4)
    extent: float  # longer side of the object in the frame, pixels
    sharpness: float  # share of the contrast that is in the finest details; larger is sharper

    @property
    def direction(self) -> NDArray[np.float64]:
        """``(3,)`` unit vector from the object's origin to the camera, in object coordinates."""
        towards = -self.T_cam_obj[:3, :3].T @ self.T_cam_obj[:3, 3]
        return np.asarray(towards / max(float(np.linalg.norm(towards)), 1e-12))


def texture_view(
    index: int,
    image: Image,
    mask: NDArray[np.bool_],
    camera: Camera,
    T_cam_obj: NDArray[np.float64],
) -> TextureView | None:
    """A frame as a texture is taken from it; None if its mask is empty or too small to have an inside.

    Args:
        index: Index of the frame.
        image: ``(H, W, 3)`` RGB.
        mask: ``(H, W)`` the object.
        camera: Camera of the full frame.
        T_cam_obj: ``(4, 4)``.
    """
    box = box_of(mask)
    if box is None:
        return None
    window = Window.around(box, _MARGIN, 1)
    window = Window(window.left, window.top, window.side, min(window.side, _LARGEST))
    inside = (crop_window(mask, window) > 0.5) & inside_frame(mask.shape, window)
    depth = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
    valid = np.clip((depth - _OUTLINE[0]) / (_OUTLINE[1] - _OUTLINE[0]), 0.0, 1.0).astype(np.float32)
    if not valid.any():
        return None
    seen = crop_window(image, window)
    return TextureView(
        index,
        seen,
        valid,
        window.K(camera),
        np.array(T_cam_obj, np.float64),
        max(box[2:]),
        _sharpness(seen, valid),
    )


def keep_best_views(views: tuple[TextureView, ...], view: TextureView, most: int) -> tuple[TextureView, ...]:
    """The views with one more; of more than ``most`` the less sharp of the two that see most alike goes."""
    if most < 1:
        return ()
    views = (*views, view)
    if len(views) <= most:
        return views
    directions = np.stack([one.direction for one in views])
    likeness = np.triu(directions @ directions.T, 1) - 2 * np.tri(len(views))
    pair = np.unravel_index(int(np.argmax(likeness)), likeness.shape)
    dropped = min((int(place) for place in pair), key=lambda place: (views[place].sharpness, -place))
    return (*views[:dropped], *views[dropped + 1 :])


def _sharpness(image: NDArray[np.uint8], valid: NDArray[np.float32]) -> float:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    within = valid > 0.5
    if not within.any():
        return 0.0
    fine = cv2.Laplacian(grey, cv2.CV_32F)[within]
    return float(np.mean(np.square(fine)) / (np.var(grey[within]) + 1.0))
