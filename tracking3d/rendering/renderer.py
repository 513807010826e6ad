"""The differentiable renderer: shape, texture and poses in; features, silhouette and visibility out.

All frames are one batch, each with its own pose and window, over one mesh or one mesh a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.shapes import check_shapes
from tracking3d.rendering.silhouette import BOXLEN, KNUM, SIGMA, soft_silhouette
from tracking3d.rendering.texture import sample_texture
from tracking3d.rendering.visibility import NEAR, rasterize


@dataclass(frozen=True)
class SoftBand:
    """The kernel of the soft silhouette, in NDC: see `soft_silhouette`."""

    sigma: float = SIGMA
    boxlen: float = BOXLEN
    knum: int = KNUM


@dataclass(frozen=True, eq=False)
class Rendering:
    """What the renderer answers.

    Attributes:
        face_index: ``(B, H, W)`` int64, -1 where uncovered.
        depth: ``(B, H, W)`` z in camera coordinates, infinite where uncovered; no gradient.
        silhouette: ``(B, H, W)`` soft, in [0, 1].
        pixels: ``(P,)`` int64, flat indices of the covered pixels in ``(B, H, W)``.
        uv: ``(P, 2)`` texture coordinates at the covered pixels.
        features: ``(P, C)`` texture at the covered pixels.
    """

    face_index: Tensor
    depth: Tensor
    silhouette: Tensor
    pixels: Tensor
    uv: Tensor
    features: Tensor

    def image(self) -> Tensor:
        """The features as ``(B, C, H, W)``, zero where uncovered."""
        batch, height, width = self.face_index.shape
        flat = self.features.new_zeros(batch * height * width, self.features.shape[1])
        flat = flat.index_copy(0, self.pixels, self.features)
        return flat.reshape(batch, height, width, -1).permute(0, 3, 1, 2)


def project(vertices: Tensor, R: Tensor, t: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """Project vertices into each frame.

    Args:
        vertices: ``(V, 3)``, or ``(B, V, 3)`` with one mesh a frame, in object coordinates.
        R: ``(B, 3, 3)`` rotation of ``T_cam_obj``.
        t: ``(B, 3)`` translation of ``T_cam_obj``.
        K: ``(B, 3, 3)`` intrinsics of each frame's window.

    Returns:
        ``(B, V, 2)`` pixels and ``(B, V)`` depths z in camera coordinates.
    """
    x_cam = vertices @ R.transpose(1, 2) + t[:, None]
    depth = x_cam[..., 2]
    ray = x_cam[..., :2] / depth.clamp_min(NEAR)[..., None]
    focal = torch.stack([K[:, 0, 0], K[:, 1, 1]], 1)
    return ray * focal[:, None] + K[:, None, :2, 2], depth


def render(
    vertices: Tensor,
    faces: Tensor,
    face_uvs: Tensor,
    texture: Tensor,
    R: Tensor,
    t: Tensor,
    K: Tensor,
    size: tuple[int, int],
    band: SoftBand | None = None,
) -> Rendering:
    """Render a textured mesh in every frame.

    Differentiable in ``vertices``, ``face_uvs``, ``texture``, ``R``, ``t`` and ``K``; visibility is held fixed.

    Args:
        vertices: ``(V, 3)`` or ``(B, V, 3)`` object coordinates.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside.
        face_uvs: ``(F, 3, 2)`` texture coordinates of the face corners.
        texture: ``(C, T, T)``.
        R: ``(B, 3, 3)``; t: ``(B, 3)``; K: ``(B, 3, 3)``, see `project`.
        size: ``(H, W)`` of every window.
        band: Kernel of the soft silhouette; DIB-R's constants if None.

    Raises:
        ValueError: If a shape does not fit; it names the actual and the expected shape.
    """
    check_shapes(
        R=(R, "B 3 3"),
        t=(t, "B 3"),
        K=(K, "B 3 3"),
        vertices=(vertices, "B V 3" if vertices.dim() == 3 else "V 3"),
        faces=(faces, "F 3"),
        face_uvs=(face_uvs, "F 3 2"),
        texture=(texture, "C T T"),
    )
    band = band or SoftBand()
    screen, depth = project(vertices, R, t, K)
    visibility = rasterize(screen.detach(), depth.detach(), faces, size)
    index = visibility.face_index
    silhouette = soft_silhouette(screen, depth, faces, index, band.sigma, band.boxlen, band.knum)
    uv = interpolate(screen, depth, faces, face_uvs, index)
    pixels = torch.nonzero(index.reshape(-1) >= 0)[:, 0]
    return Rendering(index, visibility.depth, silhouette, pixels, uv, sample_texture(texture, uv))
