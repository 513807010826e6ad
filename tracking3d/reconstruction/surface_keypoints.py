"""Keypoints of a frame with the points of the object's surface that they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.estimation.online.features.sift import Keypoints, detect
from tracking3d.frames import Image
from tracking3d.geometry.camera import Camera
from tracking3d.rendering.renderer import project
from tracking3d.rendering.visibility import rasterize
from tracking3d.trackers.crops import box_of

_APART = 8.0  # degrees between frames
_MOST = 60  # frames
_MARGIN = 3  # pixels that keypoints stay away from the outline, where the surface is steep


@dataclass(frozen=True, eq=False)
class SurfaceKeypoints:
    """Keypoints of one frame."""

    keypoints: Keypoints  # the N keypoints; pixels are the frame's
    points: NDArray[np.float64]  # (N, 3) in object coordinates
    P: NDArray[np.float64]  # (3, 4) from object coordinates to pixels of the frame, times the depth
    T_cam_obj: NDArray[np.float64]  # (4, 4)
    length: float  # longer side of the object in the frame, pixels


def shows_other_side(kept: Sequence[SurfaceKeypoints], T_cam_obj: NDArray[np.float64]) -> bool:
    """Whether a frame with a pose ``(4, 4)`` shows something that the frames at hand do not."""
    if len(kept) >= _MOST:
        return False
    traces = [np.trace(one.T_cam_obj[:3, :3].T @ T_cam_obj[:3, :3]) for one in kept]
    return max(traces, default=-1.0) < 1 + 2 * np.cos(np.radians(_APART))


def surface_keypoints(
    image: Image,
    mask: NDArray[np.bool_],
    camera: Camera,
    T_cam_obj: NDArray[np.float64],
    model: ObjectModel,
) -> SurfaceKeypoints:
    """Detect keypoints on the object where its surface is known.

    Args:
        image: ``(H, W, 3)`` RGB.
        mask: ``(H, W)`` what is seen of the object.
        camera: Camera of the frame.
        T_cam_obj: ``(4, 4)``.
        model: The object.
    """
    height, width = mask.shape
    K = camera.K
    T = torch.from_numpy(np.asarray(T_cam_obj, np.float64)[None]).float()
    screen, z = project(
        torch.from_numpy(model.vertices).float(), T[:, :3, :3], T[:, :3, 3], torch.from_numpy(K[None]).float()
    )
    depth = rasterize(screen, z, torch.from_numpy(model.faces), (height, width)).depth[0].numpy()
    kernel = np.ones((2 * _MARGIN + 1,) * 2, np.uint8)
    region = cv2.erode((mask & np.isfinite(depth)).astype(np.uint8), kernel) > 0
    box = box_of(mask)
    length = float(max(box[2:])) if box is not None else 1.0
    found = detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), region, length)
    P = K @ np.asarray(T_cam_obj)[:3]
    column, row = np.rint(found.pixel).astype(int).T if len(found) else np.zeros((2, 0), int)
    there = depth[row.clip(0, height - 1), column.clip(0, width - 1)].astype(np.float64)
    rays = np.column_stack([found.pixel, np.ones(len(found))]) @ np.linalg.inv(K).T
    known = np.isfinite(there)
    camera_points = rays[known] * there[known, None]
    points = (camera_points - T_cam_obj[:3, 3]) @ T_cam_obj[:3, :3]
    kept = Keypoints(found.pixel[known], found.descriptor[known])
    return SurfaceKeypoints(kept, points, P, np.asarray(T_cam_obj), length)
