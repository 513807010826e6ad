"""What the renderer is compared with: all pixels times all faces, and autograd does the rest.

The formulas of `tracking3d.rendering` written down once for every pair, without lists, culling by boxes or
gradients by hand. Pixels are taken in chunks which are computed again for the backward pass; the graph of all
pairs of 7 frames would not fit into memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from tracking3d.geometry.camera import NEAR
from tracking3d.rendering import Rendering, SoftBand
from tracking3d.rendering.renderer import to_camera, to_screen

CHUNK = 200_000
"""Pairs that are computed at once; larger chunks are slower, they leave the processor's cache."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PrecomputedRendering(Rendering):
    """A rendering of another implementation, which gives everything at once."""

    given_silhouette: Tensor  # the `silhouette`
    given_uv: Tensor  # the `uv`

    @cached_property
    def silhouette(self) -> Tensor:
        """See `Rendering.silhouette`."""
        return self.given_silhouette

    @cached_property
    def uv(self) -> Tensor:
        """See `Rendering.uv`."""
        return self.given_uv


def render_dense(
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
    """The same as `tracking3d.rendering.render`, densely; its depth has a gradient."""
    band = band or SoftBand()
    height, width = size
    x_cam = to_camera(vertices, R, t)
    screen, depth = to_screen(x_cam, K), x_cam[..., 2]
    extent = screen.new_tensor([width, height])
    y, x = torch.meshgrid(*(torch.arange(side, device=screen.device) for side in size), indexing="ij")
    points = (2 * torch.stack([x, y], 2).reshape(-1, 2) + 1 - extent) / extent
    chunks = points.split(max(CHUNK // len(faces), 1))
    results = [
        checkpoint(_pixels_by_faces, corner, z, face_uvs, chunk, band, use_reentrant=False)
        for corner, z in zip((2 * screen[:, faces] + 1 - extent) / extent, depth[:, faces], strict=True)
        for chunk in chunks
    ]
    index, silhouette, nearest, uv = (torch.cat(parts) for parts in zip(*results, strict=True))
    pixels = torch.nonzero(index >= 0)[:, 0]
    shape = (len(R), height, width)
    uv = uv[pixels]
    return PrecomputedRendering(
        face_index=index.reshape(shape),
        depth=nearest.reshape(shape),
        pixels=pixels,
        texture=texture,
        x_cam=x_cam,
        screen=screen,
        faces=faces,
        face_uvs=face_uvs,
        K=K,
        band=band,
        backend="torch",
        given_silhouette=silhouette.reshape(shape),
        given_uv=uv,
    )


def _pixels_by_faces(
    corner: Tensor, z: Tensor, face_uvs: Tensor, point: Tensor, band: SoftBand
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Face index, silhouette, depth ``(N,)`` and uv ``(N, 2)`` of points ``(N, 2)`` of one frame.

    Args:
        corner: ``(F, 3, 2)`` in NDC; z: ``(F, 3)``; face_uvs: ``(F, 3, 2)``.
        point: In NDC.
        band: Kernel of the silhouette.
    """
    # Planes (3, N, F): one for each corner, or for the edge from it to the next.
    ax, ay = corner.permute(2, 1, 0)[:, :, None]
    ex, ey = ax.roll(-1, 0) - ax, ay.roll(-1, 0) - ay
    dx, dy = point[:, :1] - ax, point[:, 1:] - ay
    in_front = z.amin(1) > NEAR

    # Twice the area that an edge spans with the point belongs to the corner before it.
    spanned = (ey * dx - ex * dy).roll(-1, 0)
    area = spanned.sum(0)
    inside = (spanned >= 0).all(0) & (area > 0) & in_front
    weight = spanned / torch.where(inside, area, 1.0) / z.T[:, None]
    inverse_depth = torch.where(inside, weight.sum(0), 0.0)
    nearest, winner = inverse_depth.max(1)
    covered = nearest > 0
    index = torch.where(covered, winner, -1)
    share = weight[:, torch.arange(len(point), device=point.device), winner]
    share = share / torch.where(covered, nearest, 1.0)
    uv = (share[..., None] * face_uvs[winner].transpose(0, 1)).sum(0)

    along = ((dx * ex + dy * ey) / (ex**2 + ey**2)).clamp(0, 1)
    squared = ((dx - along * ex) ** 2 + (dy - along * ey) ** 2).amin(0)
    low, high = corner.amin(1).T - band.boxlen, corner.amax(1).T + band.boxlen
    x, y = point[:, :1], point[:, 1:]
    near = (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1]) & in_front
    near = near & (near.cumsum(1) <= band.knum)
    rest = (1 - torch.exp(-band.sigma * torch.where(near, squared, torch.inf))).prod(1)
    silhouette = torch.where(covered, 1.0, 1 - rest)
    return index, silhouette, 1 / nearest, uv
