"""Views of the textured mesh from any side."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.frames import Image
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.texture import sample_texture
from tracking3d.rendering.visibility import rasterize

_BACKGROUND = 40.0
_UNSEEN = 165.0
_AMBIENT, _AMBIENT_UNSEEN = 0.45, 0.75  # unseen surface stays pale even if it faces away
_DISTANCE = 4.0  # of the camera, in radii of the object
_FILL = 0.8  # of the picture's side
_FINEST = 4  # texels of a texture's side for a pixel of the picture's


def side_shown(T_cam_obj: NDArray[np.float64], middle: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """``(3, 3)`` rotation that shows the object, moved to the middle of the picture, from the side a frame shows.

    Args:
        T_cam_obj: ``(4, 4)``; the ray to the object is turned to the camera's axis.
        middle: ``(3,)`` the object's middle.

    Returns:
        None if the pose is no number, or the object not before the camera.
    """
    if not np.isfinite(T_cam_obj).all():
        return None
    ray = T_cam_obj[:3, :3] @ middle + T_cam_obj[:3, 3]
    if not ray[2] > 0:
        return None
    axis = np.array([ray[1], -ray[0], 0.0])  # the ray's cross product with the camera's axis
    sine = float(np.linalg.norm(axis))
    if sine > 0:
        axis *= math.atan2(sine, ray[2]) / sine
    rotation: NDArray[np.float64] = Rotation.from_rotvec(axis).as_matrix() @ T_cam_obj[:3, :3]
    return rotation


def most_different(rotations: NDArray[np.float64], count: int) -> list[int]:
    """Which of ``(N, 3, 3)`` rotations to show: the first, and always the one that is the furthest from all before."""
    chosen = [0]
    nearness = np.full(len(rotations), -np.inf)
    while len(chosen) < min(count, len(rotations)):
        # The trace of the relative rotation falls as the angle grows.
        nearness = np.maximum(nearness, np.einsum("nij,ij->n", rotations, rotations[chosen[-1]]))
        nearness[chosen] = np.inf
        chosen.append(int(nearness.argmin()))
    return chosen


def texture_of_views(model: ObjectModel, size: int) -> Tensor:
    """The texture that views of a size sample ``(4, H, W)``: the colour of what was seen, and how much of it was.

    Args:
        model: The object.
        size: Side of the views in pixels; a texture that is much finer is averaged.
    """
    seen = (model.texture_weight > 0)[..., None]
    layers = np.concatenate([model.texture * seen, seen], axis=2, dtype=np.float32)
    while min(layers.shape[:2]) >= _FINEST * size:
        layers = cv2.resize(
            layers, (layers.shape[1] // 2, layers.shape[0] // 2), interpolation=cv2.INTER_AREA
        )
    return torch.tensor(np.ascontiguousarray(layers.transpose(2, 0, 1)))


def render_view(
    model: ObjectModel, rotation: NDArray[np.float64], size: int, texture: Tensor | None = None
) -> Image:
    """Draw the whole object, lit from the camera, into a square picture ``(size, size, 3)``.

    Texels that were never seen are of a pale grey.

    Args:
        model: The object.
        rotation: ``(3, 3)`` object to camera.
        size: Side in pixels.
        texture: See `texture_of_views`; made here if left out. Several views of one object share it.
    """
    import trimesh  # slow to import

    texture = texture_of_views(model, size) if texture is None else texture
    low, high = model.vertices.min(0), model.vertices.max(0)
    centred = (model.vertices - (low + high) / 2) @ rotation.T
    radius = max(float(np.linalg.norm(centred, axis=1).max()), 1e-12)
    points = centred / radius + (0.0, 0.0, _DISTANCE)
    focal = 0.5 * _FILL * size * math.sqrt(_DISTANCE**2 - 1)
    screen = torch.tensor(focal * points[:, :2] / points[:, 2:] + (size - 1) / 2, dtype=torch.float32)[None]
    depth = torch.tensor(points[:, 2], dtype=torch.float32)[None]
    faces = torch.tensor(model.faces)
    face_index = rasterize(screen, depth, faces, (size, size)).face_index

    normals = trimesh.Trimesh(centred, model.faces, process=False).vertex_normals
    corners = np.concatenate([model.face_uvs, normals[model.faces], centred[model.faces] / radius], axis=2)
    uv, normal, at = interpolate(
        screen, depth, faces, torch.tensor(corners, dtype=torch.float32), face_index
    ).split([2, 3, 3], dim=1)
    colour, weight = sample_texture(texture, uv).split([3, 1], dim=1)
    ambient = weight * _AMBIENT + (1 - weight) * _AMBIENT_UNSEEN
    colour = colour + (1 - weight) * _UNSEEN
    to_camera = torch.nn.functional.normalize(
        torch.tensor([0.0, 0.0, -_DISTANCE], dtype=at.dtype) - at, dim=1
    )
    facing = (torch.nn.functional.normalize(normal, dim=1) * to_camera).sum(1, keepdim=True).clamp(0, 1)
    picture = torch.full((size, size, 3), _BACKGROUND, dtype=colour.dtype)
    picture[face_index[0] >= 0] = colour * (ambient + (1 - ambient) * facing)
    result: Image = picture.round().clamp(0, 255).to(torch.uint8).numpy()
    return result
