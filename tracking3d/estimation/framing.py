"""Boxes around the object in the frame: where a mask is, and where a pose puts the object."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from tracking3d.frames import Box
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.pose import Pose


def projected_box(vertices: Tensor, camera: Camera, pose: Pose) -> Box | None:
    """Box ``(x, y, w, h)`` of the projected vertices inside the frame; None where none is or one is behind."""
    x_cam = vertices @ pose.R.T + pose.translation
    if not bool((x_cam[:, 2] > 1e-3).all()):
        return None
    focal = x_cam.new_tensor([camera.fx, camera.fy])
    pixel = x_cam[:, :2] / x_cam[:, 2:] * focal + x_cam.new_tensor([camera.cx, camera.cy])
    # Of an object right before the camera all but a little lies outside, and could be any number of pixels.
    size = x_cam.new_tensor([camera.width, camera.height])
    low, high = (bound.clamp_min(0.0).minimum(size) for bound in (pixel.amin(0), pixel.amax(0)))
    if not bool((low < high).all()):
        return None
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


def mask_box(mask: NDArray[np.bool_]) -> Box:
    """Box ``(x, y, w, h)`` of a non-empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    left, top = float(columns[0]), float(rows[0])
    return left, top, float(columns[-1] + 1) - left, float(rows[-1] + 1) - top
