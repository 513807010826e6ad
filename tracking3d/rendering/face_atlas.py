"""An atlas in which every face has a place of its own, for meshes that come without one; and colours baked into it."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.rendering.backprojection import TexelMap

_MARGIN = 0.12  # of a cell, between its two triangles and around them
_CROWDED = 1.15
"""Area of an atlas's triangles over that of the texels they cover, from which on faces share texels."""
_PROBED = 512  # texels along a side of the atlas that is asked for that


def face_atlas(count: int) -> NDArray[np.float64]:
    """Texture coordinates ``(F, 3, 2)`` for ``count`` faces: two right triangles in each cell of a grid."""
    side = math.ceil(math.sqrt(math.ceil(count / 2)))
    low, high, gap = _MARGIN, 1 - _MARGIN, 1 - 2.5 * _MARGIN
    lower = np.array([[low, low], [gap, low], [low, gap]])
    upper = np.array([[high, high], [1 - gap, high], [high, 1 - gap]])
    face = np.arange(count)
    cell = face // 2
    corner = np.stack([cell % side, cell // side], 1)[:, None]
    return np.asarray((np.where((face % 2 == 0)[:, None, None], lower, upper) + corner) / side)


def shares_no_texel(face_uvs: NDArray[np.float64]) -> bool:
    """Whether every face of an atlas ``(F, 3, 2)`` has a place of its own inside it."""
    if face_uvs.min() < -1e-6 or face_uvs.max() > 1 + 1e-6:
        return False
    ab, ac = face_uvs[:, 1] - face_uvs[:, 0], face_uvs[:, 2] - face_uvs[:, 0]
    area = 0.5 * np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).sum() * _PROBED**2
    covered = len(TexelMap.of(torch.from_numpy(face_uvs).float(), _PROBED).texel)
    return bool(0 < area < _CROWDED * covered)


def on_faces(values: NDArray[np.float64], texels: TexelMap) -> NDArray[np.float64]:
    """``(N, C)`` what the faces' corners ``(F, 3, C)`` say of each texel."""
    face, share = texels.face.numpy(), texels.barycentric.numpy()
    return np.asarray((values[face] * share[..., None]).sum(1))


def paint_faces(colours: NDArray[np.float64], texels: TexelMap) -> NDArray[np.uint8]:
    """A texture ``(T, T, 3)``; outside the faces it repeats the nearest texel, so that no seam shows.

    Args:
        colours: ``(N, 3)`` in [0, 255], of the texels.
        texels: The atlas.
    """
    size, texel = texels.size, texels.texel.numpy()
    texture = np.zeros((size * size, 3), np.uint8)
    texture[texel] = colours.round().clip(0, 255)
    empty = np.ones(size * size, np.uint8)
    empty[texel] = 0
    _, label = cv2.distanceTransformWithLabels(
        empty.reshape(size, size), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(int(label.max()) + 1, np.int64)
    nearest[label.reshape(-1)[texel]] = texel
    return np.asarray(texture[nearest[label.reshape(-1)]].reshape(size, size, 3))
