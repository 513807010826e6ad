"""Texture in closed form: what a frame shows of every texel.

Each texel of the atlas is a point of the surface. It is projected into the frame, kept where it is visible
(depth test, front-facing), and takes the frame's value there, weighted by the squared cosine of the viewing
angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.interpolation import barycentrics
from tracking3d.rendering.renderer import project
from tracking3d.rendering.visibility import nearest_depth, rasterize

_DEPTH_TOLERANCE = 0.02
"""A texel is hidden if something is nearer by more than this share of the mesh's radius."""
_GRAZING = 0.15
"""Texels seen at a smaller cosine are ignored: the outline is uncertain by a pixel or so."""
_TEXELS_AT_ONCE = 1 << 16  # a large atlas has millions, and what is computed with them is ten times as large


@dataclass(frozen=True, eq=False)
class TexelMap:
    """Where each texel of an atlas lies on the surface; fixed as long as faces and texture coordinates are."""

    size: int  # side T of the texture
    texel: Tensor  # (N,) flat indices of the texels that lie on a face
    face: Tensor  # (N,) that face
    barycentric: Tensor  # (N, 3) place on that face

    @classmethod
    def of(cls, face_uvs: Tensor, size: int) -> TexelMap:
        """Rasterize the atlas ``(F, 3, 2)``; faces across the seam are drawn on both sides."""
        count = len(face_uvs)
        corner = face_uvs * size - 0.5
        both = torch.cat([corner, corner - corner.new_tensor([float(size), 0.0])])
        triangles = torch.arange(6 * count, device=corner.device).reshape(-1, 3)
        # An atlas may hold charts that are mirrored; drawn they are from whichever side shows.
        ab, ac = both[:, 1] - both[:, 0], both[:, 2] - both[:, 0]
        mirrored = ab[:, 0] * ac[:, 1] > ab[:, 1] * ac[:, 0]
        triangles[mirrored] = triangles[mirrored].flip(1)
        flat = both.reshape(1, -1, 2)
        index = rasterize(flat, torch.ones_like(flat[..., 0]), triangles, (size, size)).face_index.reshape(-1)
        texel = torch.nonzero(index >= 0)[:, 0]
        drawn = index[texel]
        del index
        weights = corner.new_empty(3, len(texel))
        for first in range(0, len(texel), _TEXELS_AT_ONCE):
            some = slice(first, first + _TEXELS_AT_ONCE)
            x, y = texel[some] % size, torch.div(texel[some], size, rounding_mode="floor")
            corner_x, corner_y = both[drawn[some]].permute(2, 1, 0)
            weights[:, some], _, _ = barycentrics(corner_x, corner_y, x.to(corner), y.to(corner))
        return cls(size, texel, drawn % count, weights.T)


@dataclass(frozen=True, eq=False)
class BackProjection:
    """Weighted sums of what was seen of each texel; sums over frames add up."""

    total: Tensor  # (C, T, T) weighted sum of values
    weight: Tensor  # (T, T) sum of weights

    def __add__(self, other: BackProjection) -> BackProjection:
        """What both have seen."""
        return BackProjection(self.total + other.total, self.weight + other.weight)

    def mean(self) -> Tensor:
        """``(C, T, T)`` weighted mean, zero where nothing was seen."""
        return self.total / self.weight.clamp_min(1e-8)


@dataclass(frozen=True, eq=False)
class SeenTexels:
    """What a frame shows of some texels."""

    texel: Tensor  # (N,) flat indices, each once
    values: Tensor  # (C, N) the frame's values there
    weight: Tensor  # (N,) squared cosine of the viewing angle, times the weight of the frame there; above 0


def back_project(
    values: Tensor,
    valid: Tensor,
    vertices: Tensor,
    faces: Tensor,
    texels: TexelMap,
    R: Tensor,
    t: Tensor,
    K: Tensor,
    backend: str = "auto",
) -> BackProjection:
    """What one frame shows of the texture; see `seen_texels` for the arguments."""
    seen = seen_texels(values, valid, vertices, faces, texels, R, t, K, backend)
    size = texels.size
    total = values.new_zeros(values.shape[0], size * size)
    total[:, seen.texel] = seen.values * seen.weight
    count = values.new_zeros(size * size)
    count[seen.texel] = seen.weight
    return BackProjection(total.reshape(-1, size, size), count.reshape(size, size))


@torch.no_grad()
def seen_texels(
    values: Tensor,
    valid: Tensor,
    vertices: Tensor,
    faces: Tensor,
    texels: TexelMap,
    R: Tensor,
    t: Tensor,
    K: Tensor,
    backend: str = "auto",
) -> SeenTexels:
    """The texels that one frame shows.

    Args:
        values: ``(C, H, W)`` colours or features of the frame.
        valid: ``(H, W)`` in [0, 1], weight of each pixel.
        vertices: ``(V, 3)`` in object coordinates.
        faces: ``(F, 3)``.
        texels: The atlas.
        R: ``(3, 3)``; t: ``(3,)``: ``T_cam_obj``.
        K: ``(3, 3)`` of the window.
        backend: See `tracking3d.rendering.backend`.
    """
    height, width = values.shape[1:]
    screen, depth = project(vertices, R[None], t[None], K[None])
    drawn = nearest_depth(screen[0], depth[0], faces, (height, width), backend)
    x_cam = vertices @ R.T + t
    corner = x_cam[faces]
    normal = functional.normalize(
        torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), dim=1
    )
    # A face that turns away from all of its corners shows no texel: most of a large atlas is left out so.
    facing = ((corner * normal[:, None]).sum(2) < 0).any(1)
    radius = (vertices - vertices.mean(0)).norm(dim=1).max()
    if use_numba(backend, values, valid, vertices, texels.barycentric):
        from tracking3d.rendering.kernels import backprojection

        atlas = texels.texel, texels.face, texels.barycentric
        tolerance = _DEPTH_TOLERANCE * float(radius)
        seen = backprojection.seen_texels(
            values, valid, drawn, corner, normal, facing, atlas, K, _GRAZING, tolerance
        )
        return SeenTexels(*seen)
    front = torch.nonzero(facing[texels.face])[:, 0]
    face, texel = texels.face[front], texels.texel[front]
    point = (corner[face] * texels.barycentric[front, :, None]).sum(1)
    cosine = -(normal[face] * functional.normalize(point, dim=1)).sum(1)
    front = torch.nonzero((cosine > _GRAZING) & (point[:, 2] > 0))[:, 0]
    point, cosine, texel = point[front], cosine[front], texel[front]

    pixel = torch.stack([K[0, 0], K[1, 1]]) * point[:, :2] / point[:, 2:] + K[:2, 2]
    grid = ((2 * pixel + 1) / pixel.new_tensor([width, height]) - 1)[None, None]
    nearest = functional.grid_sample(
        torch.where(drawn.isinf(), 0.0, drawn)[None, None], grid, mode="nearest", align_corners=False
    )[0, 0, 0]
    visible = (nearest > 0) & (point[:, 2] < nearest + _DEPTH_TOLERANCE * radius / cosine)
    layers = torch.cat([values, valid[None]])
    sampled = functional.grid_sample(layers[None], grid, mode="bilinear", align_corners=False)[0, :, 0]
    weight = cosine.square() * visible * sampled[-1]
    known = torch.nonzero(weight > 0)[:, 0]
    return SeenTexels(texel[known], sampled[:-1, known], weight[known])


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
