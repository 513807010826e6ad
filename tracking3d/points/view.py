"""Windows of frames in which points are followed: grey values around the object, and the mesh drawn into them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera, Window
from tracking3d.scene.surface import Drawn, draw
from tracking3d.scene.view import Array, FrameCrop, ObjectView, crop_window, project_points

LONGEST_SIDE = 320
"""Pixels of a window, where nothing else is said."""
LANDMARK_WINDOW = 240
"""Pixels of the windows in which landmarks are followed that adjust a map or a whole video."""
MARGIN = 12
"""Frame pixels around mask and mesh that belong to the window."""
REACH = 12.0
"""Window pixels beyond the drawn outline up to which the surface is carried on."""


def cut_window(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    camera: Camera,
    T_cam_obj: Array,
    vertices: Array,
    longest_side: int = LONGEST_SIDE,
) -> FrameCrop | None:
    """The window of a frame around its mask and the projected mesh, with grey values and a mask of uint8 to 255.

    Args:
        image: ``(H, W, 3)`` RGB.
        mask: ``(H, W)``.
        camera: The camera of the frame.
        T_cam_obj: ``(4, 4)``.
        vertices: ``(V, 3)``.
        longest_side: Pixels of the window; a larger one is scaled down.

    Returns:
        The window, or None if the pose is no number or nothing of the object lies in the frame.
    """
    xy, _ = project_points(vertices, camera.K, T_cam_obj)
    if not np.isfinite(xy).all():
        return None
    size = np.array([camera.width, camera.height])
    x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
    corners = [(x, y), (x + width - 1, y + height - 1)] if width else []
    pixels = np.concatenate([xy, np.reshape(corners, (-1, 2))])
    low = np.clip(np.floor(pixels.min(0)) - MARGIN, 0, size).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + MARGIN + 1, 0, size).astype(int)
    if (high - low < 8).any():
        return None
    (left, top), (across, down) = low.tolist(), (high - low).tolist()
    factor = min(1.0, longest_side / max(across, down))
    width, height = (max(round(side * factor), 8) for side in (across, down))
    window = Window(left, top, across, width, (down, height))
    region, here = (slice(top, top + down), slice(left, left + across)), replace(window, left=0, top=0)
    grey = crop_window(cv2.cvtColor(image[region], cv2.COLOR_RGB2GRAY), here)
    inside = crop_window(mask[region].astype(np.uint8) * np.uint8(255), here)
    return FrameCrop(window, grey, mask.shape, inside)


def draw_into_window(
    crop: FrameCrop, camera: Camera, T_cam_obj: Array, vertices: Array, faces: NDArray[np.int64]
) -> Drawn:
    """A window of `cut_window` with the mesh drawn into it, ``(V, 3)`` vertices and ``(F, 3)`` faces."""
    assert crop.mask is not None
    view = ObjectView(
        crop.window, cv2.GaussianBlur(crop.image.astype(np.float32), (0, 0), 0.5), crop.frame_size,
        mask=crop.mask.astype(np.float32) / np.float32(255), K=crop.window.K(camera), T_cam_obj=T_cam_obj,
    )  # fmt: skip
    return draw(view, vertices, faces, REACH)


def open_view(
    image: NDArray[np.uint8],
    mask: NDArray[np.bool_],
    camera: Camera,
    T_cam_obj: Array,
    vertices: Array,
    faces: NDArray[np.int64],
    longest_side: int = LONGEST_SIDE,
) -> Drawn | None:
    """`cut_window` and `draw_into_window` at once."""
    window = cut_window(image, mask, camera, T_cam_obj, vertices, longest_side)
    return None if window is None else draw_into_window(window, camera, T_cam_obj, vertices, faces)


def redraw_surface(view: Drawn, vertices: Array, faces: NDArray[np.int64], T_cam_obj: Array) -> Drawn:
    """The view with the mesh drawn into it at another pose."""
    return draw(replace(view, T_cam_obj=T_cam_obj), vertices, faces, REACH)
