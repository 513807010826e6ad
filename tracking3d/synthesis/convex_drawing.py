"""Images of a posed surface by casting rays: shaded by one fixed light, antialiased, with an exact mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera
from tracking3d.synthesis.convex_raycast import ConvexSurface
from tracking3d.synthesis.procedural_texture import FloatImage, sample_panels

LIGHT = np.array([-0.45, -0.7, -0.55]) / np.linalg.norm([-0.45, -0.7, -0.55])
"""Unit direction towards the light in camera axes: from the upper left, behind the camera."""

AMBIENT, DIFFUSE = 0.6, 0.5
"""Share of a colour that is seen in the shade, and what facing the light adds."""


def draw_convex(
    pose: NDArray[np.float64],
    camera: Camera,
    surface: ConvexSurface,
    panels: FloatImage,
    background: FloatImage,
    supersample: int,
) -> tuple[FloatImage, NDArray[np.bool_]]:
    """One noiseless image and its mask.

    Args:
        pose: ``(4, 4)`` object to camera.
        camera: Camera of the full frame.
        surface: The object.
        panels: ``(P, S, S, 3)`` texture of its panels.
        background: ``(H, W, 3)``.
        supersample: Rays per pixel and axis; odd, so that the middle one goes through the pixel's centre.

    Returns:
        Image ``(H, W, 3)`` float32 in [0, 255], and mask ``(H, W)``: whether a pixel's middle ray
        meets the object.
    """
    R, t = pose[:3, :3], pose[:3, 3]
    image, mask = background.copy(), np.zeros(background.shape[:2], bool)
    left, top, right, bottom = _bounds(t, surface.radius, camera)
    rows, columns = bottom - top, right - left
    if rows <= 0 or columns <= 0:
        return image, mask
    offset = (np.arange(supersample) - supersample // 2) / supersample
    y = (np.arange(top, bottom)[:, None] + offset).reshape(-1)
    x = (np.arange(left, right)[:, None] + offset).reshape(-1)
    u, v = np.meshgrid((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    hits = surface.cast(-R.T @ t, rays @ R)
    hit = hits.hit
    colours = np.repeat(np.repeat(image[top:bottom, left:right], supersample, 0), supersample, 1).reshape(
        -1, 3
    )
    light = np.maximum(hits.normals[hit] @ (R.T @ LIGHT), 0)
    shade = (AMBIENT + DIFFUSE * light).astype(np.float32)[:, None]
    colours[hit] = np.minimum(shade * sample_panels(panels, hits.panel[hit], hits.uv[hit]), 255)
    blocks = (rows, supersample, columns, supersample)
    image[top:bottom, left:right] = colours.reshape(*blocks, 3).mean(axis=(1, 3))
    mask[top:bottom, left:right] = hit.reshape(blocks)[:, supersample // 2, :, supersample // 2]
    return image, mask


def _bounds(centre: NDArray[np.float64], radius: float, camera: Camera) -> tuple[int, int, int, int]:
    """Left, top, right and bottom (exclusive) of the image region which a sphere may cover."""
    if centre[2] <= radius:
        return 0, 0, camera.width, camera.height
    nearest = centre[2] - radius
    corners = np.array([centre[:2] - radius, centre[:2] + radius])
    # Which depth bounds the projection depends on the sign of the coordinate: take both.
    scaled = np.concatenate([corners / nearest, corners / (centre[2] + radius)])
    x = camera.fx * scaled[:, 0] + camera.cx
    y = camera.fy * scaled[:, 1] + camera.cy
    left, right = np.clip([np.floor(x.min()) - 1, np.ceil(x.max()) + 2], 0, camera.width)
    top, bottom = np.clip([np.floor(y.min()) - 1, np.ceil(y.max()) + 2], 0, camera.height)
    return int(left), int(top), int(right), int(bottom)
