"""The model of a run for the page's viewer: plain arrays and a texture image.

The picture has two halves: above the colours, below how much of each texel was ever seen. The viewer paints what was
never seen in a pale colour of the page instead of a guess. As an alpha channel it would not do: browsers forget the
colour of what is transparent. If it would be large as PNG, it is WebP, in which the eye sees no difference.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.estimation.estimate import ObjectModel
from tracking3d.results import layout
from tracking3d.results.mesh_export import load_model, split_mesh

MOST_TEXTURE = 1_500_000
"""Bytes of the picture; as text in the page it takes a third more."""
_LARGE = 300_000  # bytes of a PNG that is not worth losing anything for
_QUALITIES = (90, 75, 55, 30, 10)
MOST_FACES = 200_000
"""Faces of a model that is put into a page."""


def read_model(folder: Path) -> ObjectModel:
    """The model of a run, if it is one that can be drawn.

    Raises:
        InputError: If there is none, it cannot be read, or its arrays do not fit each other.
    """
    model = load_model(folder)
    fault = _fault(model)
    if fault:
        raise InputError(
            f"The model {folder / layout.FEATURES} {fault}; track again into another {layout.OUT}."
        )
    return model


def middle_of(model: ObjectModel) -> NDArray[np.float64]:
    """``(3,)`` the middle of the model's box, in object coordinates."""
    middle: NDArray[np.float64] = (model.vertices.min(0) + model.vertices.max(0)) / 2
    return middle


def model_data(model: ObjectModel) -> dict[str, Any]:
    """What the viewer draws: the mesh, centred and of radius 1, in object axes (y down), as base64 of float32.

    Texture coordinates have their origin in the upper left of the picture's upper half.
    """
    plain = trimesh.visual.material.SimpleMaterial()
    mesh = split_mesh(model, plain)
    centred = mesh.vertices - middle_of(model)
    radius = max(float(np.linalg.norm(centred, axis=1).max()), 1e-12)
    assert isinstance(mesh.visual, trimesh.visual.TextureVisuals)
    uv = np.asarray(mesh.visual.uv) * (1, -1) + (0, 1)
    seen = np.repeat(255 * (model.texture_weight > 0)[..., None].astype(np.uint8), 3, axis=2)
    picture = np.concatenate([model.texture, seen])[..., ::-1]
    return {
        "positions": _floats(centred / radius),
        "normals": _floats(mesh.vertex_normals),
        "coordinates": _floats(uv),
        "faces": _base64(np.asarray(mesh.faces, dtype="<u4").tobytes()),
        "texture": _picture(picture),
    }


def _picture(picture: NDArray[np.uint8]) -> str:
    """``(H, W, 3)`` BGR as the address of a picture within the page."""
    plain = cv2.imencode(".png", picture)[1].tobytes()
    if len(plain) <= _LARGE:
        return f"data:image/png;base64,{_base64(plain)}"
    for quality in _QUALITIES:
        made = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        if len(made) <= MOST_TEXTURE:
            break
    return f"data:image/webp;base64,{_base64(made)}"


def _floats(values: NDArray[np.float64]) -> str:
    return _base64(np.ascontiguousarray(values, dtype="<f4").tobytes())


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _fault(model: ObjectModel) -> str:
    """Why the arrays are no model, or nothing."""
    count = len(model.vertices)
    shapes = (
        model.vertices.shape == (count, 3)
        and model.faces.ndim == 2
        and model.faces.shape[1] == 3
        and model.face_uvs.shape == (*model.faces.shape, 2)
        and model.texture_weight.shape == model.texture.shape[:2]
    )
    if not shapes or not np.issubdtype(model.faces.dtype, np.integer):
        return "has arrays of inconsistent sizes"
    if not 0 < len(model.faces) <= MOST_FACES:
        return f"has {len(model.faces)} faces"
    if not 0 <= model.faces.min() <= model.faces.max() < count:
        return "has faces with missing vertices"
    if not (np.isfinite(model.vertices).all() and np.isfinite(model.face_uvs).all()):
        return "has vertices with invalid coordinates"
    return ""
