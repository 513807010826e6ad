"""The differentiable renderer: shape, texture and poses in; features, silhouette and visibility out.

All frames are one batch, each with its own pose and window, over one mesh or one mesh a frame. What is not asked
of a `Rendering` is not computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from tracking3d.geometry.camera import NEAR
from tracking3d.geometry.mesh import vertex_normals
from tracking3d.rendering.interpolation import interpolate
from tracking3d.rendering.silhouette import BOXLEN, KNUM, SIGMA, soft_silhouette
from tracking3d.rendering.surface import check_shapes, sample_texture
from tracking3d.rendering.visibility import rasterize


@dataclass(frozen=True)
class SoftBand:
    """The kernel of the soft silhouette, in NDC: see `soft_silhouette`."""

    sigma: float = SIGMA
    boxlen: float = BOXLEN
    knum: int = KNUM


@dataclass(frozen=True, eq=False)
class Rendering:
    """What the renderer returns. P pixels are covered, in the order of ``(face_index >= 0).nonzero()``."""

    face_index: Tensor  # (B, H, W) int64, -1 where uncovered
    depth: Tensor  # (B, H, W) z in camera coordinates, infinite where uncovered; no gradient, see `points`
    pixels: Tensor  # (P,) int64, flat indices of the covered pixels in (B, H, W)
    texture: Tensor  # (C, T, T) as given
    x_cam: Tensor  # (B, V, 3) vertices in camera coordinates
    screen: Tensor  # (B, V, 2) vertices in pixels
    faces: Tensor  # (F, 3); face_uvs: (F, 3, 2); as given
    face_uvs: Tensor
    K: Tensor  # (B, 3, 3) as given
    band: SoftBand = SoftBand()  # the kernel of the soft silhouette
    backend: str = "auto"  # which implementation was asked for

    @cached_property
    def silhouette(self) -> Tensor:
        """``(B, H, W)`` soft, in [0, 1]."""
        return soft_silhouette(
            self.screen, self.x_cam[..., 2], self.faces, self.face_index,
            self.band.sigma, self.band.boxlen, self.band.knum, self.backend,
        )  # fmt: skip

    @cached_property
    def uv(self) -> Tensor:
        """``(P, 2)`` texture coordinates at the covered pixels."""
        return interpolate(
            self.screen, self.x_cam[..., 2], self.faces, self.face_uvs, self.face_index, self.backend
        )

    @cached_property
    def features(self) -> Tensor:
        """``(P, C)`` texture at the covered pixels."""
        return sample_texture(self.texture, self.uv)

    @cached_property
    def points(self) -> Tensor:
        """``(P, 3)`` surface points seen at the covered pixels, in camera coordinates; z is the depth."""
        return self._interpolate(self.x_cam)

    @cached_property
    def normals(self) -> Tensor:
        """``(P, 3)`` unit normals of the smooth surface at the covered pixels, outward, in camera coordinates."""
        return functional.normalize(self._interpolate(vertex_normals(self.x_cam, self.faces)), dim=1)

    def image(self, values: Tensor | None = None) -> Tensor:
        """``(P, C)`` values, the features if None, as ``(B, C, H, W)``, zero where uncovered."""
        values = self.features if values is None else values
        batch, height, width = self.face_index.shape
        flat = values.new_zeros(batch * height * width, values.shape[1])
        flat = flat.index_copy(0, self.pixels, values)
        return flat.reshape(batch, height, width, -1).permute(0, 3, 1, 2)

    def _interpolate(self, of_vertices: Tensor) -> Tensor:
        """``(P, D)`` at the covered pixels of ``(B, V, D)``."""
        corners = of_vertices[:, self.faces]
        return interpolate(
            self.screen, self.x_cam[..., 2], self.faces, corners, self.face_index, self.backend
        )


def to_camera(vertices: Tensor, R: Tensor, t: Tensor) -> Tensor:
    """``(B, V, 3)`` camera coordinates of ``(V, 3)`` or ``(B, V, 3)`` object coordinates, see `project`."""
    return vertices @ R.transpose(1, 2) + t[:, None]


def to_screen(x_cam: Tensor, K: Tensor) -> Tensor:
    """``(B, V, 2)`` pixels of ``(B, V, 3)`` camera coordinates, see `project`."""
    ray = x_cam[..., :2] / x_cam[..., 2:].clamp_min(NEAR)
    focal = torch.stack([K[:, 0, 0], K[:, 1, 1]], 1)
    return ray * focal[:, None] + K[:, None, :2, 2]


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
    x_cam = to_camera(vertices, R, t)
    return to_screen(x_cam, K), x_cam[..., 2]


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
    backend: str = "auto",
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
        backend: ``auto``, ``torch`` or ``numba``, see `tracking3d.rendering.backend`.

    Raises:
        ValueError: If a shape does not fit; it names the actual and the expected shape. If the backend cannot
            render these tensors.
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
    x_cam = to_camera(vertices, R, t)
    screen = to_screen(x_cam, K)
    visibility = rasterize(screen, x_cam[..., 2], faces, size, backend)
    return Rendering(
        visibility.face_index, visibility.depth, visibility.pixels, texture, x_cam, screen, faces, face_uvs, K,
        band or SoftBand(), backend,
    )  # fmt: skip
