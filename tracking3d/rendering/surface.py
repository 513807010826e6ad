"""A textured surface, part of whose texture is known, as poses are fitted to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Surface:
    """The object as poses are fitted to it."""

    vertices: Tensor  # (V, 3) in object coordinates
    faces: Tensor  # (F, 3) int64; face_uvs: (F, 3, 2)
    face_uvs: Tensor
    texture: Tensor  # (C, T, T) features
    seen: Tensor  # (1, T, T) 1 where the texture is known, else 0
    renderer: str = "auto"  # which renderer, see `tracking3d.rendering.backend`

    @cached_property
    def layers(self) -> Tensor:
        """``(T, T, C + 1)`` texture and what is seen of it, the layers side by side in memory."""
        return torch.cat([self.texture, self.seen]).permute(1, 2, 0).contiguous()

    @cached_property
    def edges(self) -> tuple[Tensor, Tensor]:
        """See `edges_of`."""
        return edges_of(self.faces)


def edges_of(faces: Tensor) -> tuple[Tensor, Tensor]:
    """Which edge each side of each face is, and how many faces share each edge.

    Args:
        faces: ``(F, 3)`` int64. Side i of a face goes from its corner i to the one that follows.

    Returns:
        ``(F, 3)`` and ``(E,)`` int64.
    """
    start, end = faces, faces.roll(-1, 1)
    key = torch.minimum(start, end) * (faces.max() + 1 if faces.numel() else 1) + torch.maximum(start, end)
    _, edge, shared = torch.unique(key, return_inverse=True, return_counts=True)
    return edge, shared
