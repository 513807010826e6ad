"""An object with another shape: an atlas of its own, and the features and colours that the old one had nearest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.reconstruction.meshing import unwrap
from tracking3d.reconstruction.seen_vertices import seen_vertices
from tracking3d.reconstruction.shape_views import ShapeView
from tracking3d.rendering import TexelMap

_SIZE = 256


def replace_shape(
    model: ObjectModel,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    views: Sequence[ShapeView],
) -> ObjectModel:
    """The object with another surface at the same place.

    Args:
        model: As it was.
        vertices: ``(V, 3)``; faces: ``(F, 3)``.
        views: The frames that say what of it was seen.

    Returns:
        It, with a coarse texture until it gets a better one.
    """
    face_uvs = unwrap(vertices, faces)
    features, colours = len(model.features), len(model.texture)
    return replace(
        model,
        vertices=vertices,
        faces=faces,
        face_uvs=face_uvs,
        features=_transfer_texture(model, model.features, vertices, faces, face_uvs, features),
        texture=_transfer_texture(model, model.texture, vertices, faces, face_uvs, min(colours, _SIZE)),
        texture_weight=np.zeros((min(colours, _SIZE),) * 2, np.float32),
        seen=seen_vertices(vertices, faces, views),
    )


def _transfer_texture(
    model: ObjectModel,
    values: NDArray,
    vertices: NDArray[np.float64],
    faces: NDArray[np.int64],
    face_uvs: NDArray[np.float64],
    size: int,
) -> NDArray:
    """A texture ``(size, size, C)`` of the new surface from ``(T, T, C)`` of the old: from the nearest texel."""
    if len(values) > size:
        values = cv2.resize(values, (size, size), interpolation=cv2.INTER_AREA)
    old_texel, old_points = _texel_points(model.vertices, model.faces, model.face_uvs, len(values))
    texel, points = _texel_points(vertices, faces, face_uvs, size)
    _, nearest = cKDTree(old_points).query(points, eps=0.2)
    flat = values.reshape(-1, values.shape[2])
    carried = np.broadcast_to(flat.mean(0), (size * size, flat.shape[1])).astype(values.dtype)
    carried[texel] = flat[old_texel[nearest]]
    return carried.reshape(size, size, -1)


def _texel_points(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], face_uvs: NDArray[np.float64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    texels = TexelMap.of(torch.from_numpy(face_uvs).float(), size)
    corners = vertices[faces[texels.face.numpy()]]
    return texels.texel.numpy(), (corners * texels.barycentric.numpy()[..., None]).sum(1)
