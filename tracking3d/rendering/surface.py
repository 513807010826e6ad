"""A textured surface, part of whose texture is known, as poses are fitted to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional


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


def check_shapes(**tensors: tuple[Tensor, str]) -> None:
    """Compare tensors with shapes in letters; a letter stands for one size wherever it appears.

    ``check_shapes(R=(R, "B 3 3"), t=(t, "B 3"))`` wants as many translations as rotations.

    Args:
        **tensors: Each tensor with its expected shape, separated by spaces.

    Raises:
        ValueError: If a shape does not fit; it names the tensor, its shape and the expected one.
    """
    known: dict[str, int] = {}
    for name, (tensor, shape) in tensors.items():
        letters = shape.split()
        sizes = {**known, **{letter: int(letter) for letter in letters if letter.isdigit()}}
        fits = tensor.dim() == len(letters) and all(
            sizes.setdefault(letter, size) == size for letter, size in zip(letters, tensor.shape, strict=True)
        )
        if not fits:
            expected = ", ".join(str(known.get(letter, letter)) for letter in letters)
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected ({expected})")
        known = sizes


# Bilinear sampling of a texture that wraps around in u.
#
# A texture is ``(C, T, T)``. u runs to the right and wraps at 1, v runs down and is clamped; texel centres are at
# ``(i + 0.5) / T``.


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Sample ``texture`` ``(C, H, W)`` at ``uv`` ``(P, 2)``: ``(P, C)``, differentiable in both.

    A place that is not finite gives NaN.
    """
    # grid_sample takes such a place for one on the border, and its gradient reads beyond the texture there.
    sound = uv.isfinite().all(1)
    uv = torch.where(sound[:, None], uv, 0.5)
    width = texture.shape[2]
    # One column on each side makes the bilinear taps wrap; u itself may pass 1 on faces across the seam.
    wrapped = torch.cat([texture[:, :, -1:], texture, texture[:, :, :1]], 2)
    x = (uv[:, 0].remainder(1.0) * width + 1.0) / (width + 2) * 2 - 1
    grid = torch.stack([x, uv[:, 1] * 2 - 1], 1)[None, None]
    sampled = functional.grid_sample(wrapped[None], grid, padding_mode="border", align_corners=False)
    return torch.where(sound, sampled[0, :, 0], torch.nan).T


def bilinear_taps(texture: Tensor, uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same samples ``(P, C)``, and their derivatives by u and by v ``(P, C)``; not differentiable twice."""
    height, width = texture.shape[1:]
    x = uv[:, 0].remainder(1.0) * width - 0.5
    y = uv[:, 1] * height - 0.5
    free = (y > 0) & (y < height - 1)
    y = y.clamp(0, height - 1)
    left, top = x.floor(), y.floor()
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    columns = [(left.long() + step).remainder(width) for step in (0, 1)]
    rows = [(top.long() + step).clamp_max(height - 1) for step in (0, 1)]
    flat = texture.flatten(1)
    (t00, t01), (t10, t11) = (
        [flat.index_select(1, row * width + column).T for column in columns] for row in rows
    )
    upper, lower = t00 + fx * (t01 - t00), t10 + fx * (t11 - t10)
    by_x = (t01 - t00) + fy * ((t11 - t10) - (t01 - t00))
    by_v = torch.where(free[:, None], (lower - upper) * height, 0.0)
    return upper + fy * (lower - upper), by_x * width, by_v
