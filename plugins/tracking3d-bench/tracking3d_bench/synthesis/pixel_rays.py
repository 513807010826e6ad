"""Rays of the pinhole camera, and the part of the image in which an object may be."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera

Array = NDArray[np.float64]


def ray_directions(camera: Camera, x: Array, y: Array) -> Array:
    """Directions ``(N, 3)`` with z = 1 through pixels ``x``, ``y`` ``(N,)``: lengths along them are depths."""
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], axis=1)


def camera_to_pixels(camera: Camera, points: Array) -> Array:
    """Pixels ``(..., 2)`` of points ``(..., 3)`` in camera coordinates; NaN behind the camera."""
    z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    return points[..., :2] / z * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def pixels_around(
    vertices: Array, T_cam_obj: Array, camera: Camera, step: int = 1
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows ``(N,)`` of the image's pixels around the projection of ``vertices`` ``(V, 3)``.

    Every ``step``-th in both directions; all of the image if a part of the bounding box is behind the camera.
    """
    corners = np.array(list(product(*zip(vertices.min(0), vertices.max(0), strict=True))))
    pixels = camera_to_pixels(camera, corners @ T_cam_obj[:3, :3].T + T_cam_obj[:3, 3])
    size = np.array([camera.width, camera.height])
    if np.isnan(pixels).any():
        low, high = np.zeros(2, np.int64), size
    else:
        low = np.clip(np.floor(pixels.min(0)) - 1, 0, size).astype(np.int64)
        high = np.clip(np.ceil(pixels.max(0)) + 2, 0, size).astype(np.int64)
    columns, rows = np.meshgrid(np.arange(low[0], high[0], step), np.arange(low[1], high[1], step))
    return columns.ravel(), rows.ravel()
