"""A ball with a fine pattern, seen from known poses."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.geometry.camera import Camera
from tracking3d.geometry.prototypes import sphere
from tracking3d.reconstruction import texture_view
from tracking3d.rendering import render
from tracking3d.scene.view import ObjectView

SIDE = 160
CAMERA = Camera.from_fov(SIDE, SIDE, 30.0)
FINE = 256
"""Texels along a side of the pattern."""


def pattern(size: int = FINE, seed: int = 5) -> NDArray[np.float32]:
    """``(T, T, 3)`` patches of random colours, in [0.2, 0.8]."""
    random = np.random.default_rng(seed)
    patches = random.uniform(0.2, 0.8, (size // 8, size // 8, 3))
    return np.kron(patches, np.ones((8, 8, 1))).astype(np.float32)


def ball(texture: int = 16) -> ObjectModel:
    """The ball as a solver knows it: its shape, and a coarse grey texture."""
    mesh = sphere(8)
    return ObjectModel(
        np.asarray(mesh.vertices, np.float64),
        np.asarray(mesh.faces, np.int64),
        np.asarray(mesh.face_uvs, np.float64),
        np.full((texture, texture, 3), 128, np.uint8),
        np.ones((texture, texture), np.float32),
        np.zeros((texture, texture, 3), np.float32),
    )


def pose(yaw: float, pitch: float = 0.0) -> NDArray[np.float64]:
    """``(4, 4)`` in front of the camera, turned by degrees."""
    T_cam_obj = np.eye(4)
    T_cam_obj[:3, :3] = Rotation.from_euler("yx", [yaw, pitch], degrees=True).as_matrix()
    T_cam_obj[2, 3] = 5.0
    return T_cam_obj


def seen(
    T_cam_obj: NDArray[np.float64], texture: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A frame ``(H, W, 3)`` of the ball before green, and its mask ``(H, W)``."""
    model = ball()
    drawn = render(
        torch.from_numpy(model.vertices).float(),
        torch.from_numpy(model.faces),
        torch.from_numpy(model.face_uvs).float(),
        torch.from_numpy(texture).permute(2, 0, 1),
        torch.from_numpy(T_cam_obj[None, :3, :3]).float(),
        torch.from_numpy(T_cam_obj[None, :3, 3]).float(),
        torch.from_numpy(CAMERA.K[None]).float(),
        (SIDE, SIDE),
    )
    mask = drawn.face_index[0].numpy() >= 0
    image = drawn.image()[0].permute(1, 2, 0).numpy()
    frame = np.where(mask[..., None], image, (0.0, 1.0, 0.0))
    return np.clip(np.round(255 * frame), 0, 255).astype(np.uint8), mask


def view(
    index: int, yaw: float, texture: NDArray[np.float32] | None = None, pitch: float = 0.0
) -> ObjectView:
    """A view of the ball."""
    T_cam_obj = pose(yaw, pitch)
    image, mask = seen(T_cam_obj, pattern() if texture is None else texture)
    found = texture_view(ObjectView.of_frame(index, image, mask, CAMERA, T_cam_obj))
    assert found is not None
    return found
