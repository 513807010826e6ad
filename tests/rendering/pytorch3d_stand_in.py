"""The interface of PyTorch3D that the benchmark calls, as its documentation describes it, for tiny scenes.

It stands in where the package is absent: all pixels times all faces, written down from the documentation alone.
"""

from __future__ import annotations

import sys
from types import ModuleType

import pytest
import torch
from torch import Tensor


def install(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let ``import pytorch3d`` find the stand-in."""
    contents = {
        "pytorch3d": {},
        "pytorch3d.ops": {"interpolate_face_attributes": interpolate_face_attributes},
        "pytorch3d.structures": {"Meshes": Meshes},
        "pytorch3d.renderer": {},
        "pytorch3d.renderer.mesh": {"rasterize_meshes": rasterize_meshes},
    }
    for name, members in contents.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)


class Meshes:
    """A batch of meshes; packed, the faces of all stand one after the other."""

    def __init__(self, verts: Tensor, faces: Tensor) -> None:
        assert verts.dim() == faces.dim() == 3 and len(verts) == len(faces)
        self.verts, self.faces = verts, faces


def rasterize_meshes(
    meshes: Meshes,
    image_size: tuple[int, int],
    blur_radius: float,
    faces_per_pixel: int,
    perspective_correct: bool,
    clip_barycentric_coords: bool,
    cull_backfaces: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Packed faces, z, barycentrics and signed squared distances of the nearest faces of every pixel."""
    assert perspective_correct and not cull_backfaces
    (height, width), count = image_size, meshes.faces.shape[1]
    shorter = min(image_size)
    # x points left and y up.
    y = (height - 1 - 2 * torch.arange(height)) / shorter
    x = (width - 1 - 2 * torch.arange(width)) / shorter
    point = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], 2)[None, :, :, None]
    batch = torch.arange(len(meshes.verts))[:, None, None]
    corner = meshes.verts[batch, meshes.faces][:, None, None]  # (B, 1, 1, F, 3, 3)
    flat, z = corner[..., :2], corner[..., 2]
    edge = flat.roll(-1, 4) - flat
    offset = point[..., None, :] - flat
    spanned = edge[..., 0] * offset[..., 1] - edge[..., 1] * offset[..., 0]
    opposite = spanned.roll(-1, 4)
    area = opposite.sum(4)
    weight = opposite / torch.where(area == 0, 1.0, area)[..., None] / z
    share = weight / weight.sum(4, keepdim=True)
    inside = (share > 0).all(4)
    if clip_barycentric_coords:
        share = share.clamp_min(0)
        share = share / share.sum(4, keepdim=True).clamp_min(1e-5)
    depth = (share * z).sum(4)
    along = ((offset * edge).sum(5) / edge.square().sum(5)).clamp(0, 1)
    squared = (offset - along[..., None] * edge).square().sum(5).amin(4)
    counts = (area != 0) & (z.amin(4) > 0) & (inside | (squared < blur_radius))

    order = torch.where(counts, depth, torch.inf).argsort(3)[..., :faces_per_pixel]
    kept = counts.gather(3, order)
    face = order + count * batch[..., None]
    signed = torch.where(inside, -squared, squared).gather(3, order)
    shares = share.gather(3, order[..., None].expand(*order.shape, 3))
    return (
        torch.where(kept, face, -1),
        torch.where(kept, depth.gather(3, order), -1.0),
        torch.where(kept[..., None], shares, -1.0),
        torch.where(kept, signed, -1.0),
    )


def interpolate_face_attributes(
    pix_to_face: Tensor, barycentric_coords: Tensor, face_attributes: Tensor
) -> Tensor:
    """``(N, H, W, K, D)`` at the pixels of ``(faces of all meshes, 3, D)``; zero where no face is."""
    corners = face_attributes[pix_to_face.clamp_min(0)]
    values = (barycentric_coords[..., None] * corners).sum(4)
    return torch.where((pix_to_face >= 0)[..., None], values, 0.0)
