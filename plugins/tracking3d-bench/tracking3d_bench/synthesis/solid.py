"""An object of a synthetic sequence: shape, colours, symmetries."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solid:
    """An object in its own coordinates."""

    vertices: Array  # (V, 3)
    faces: NDArray[np.int64]  # (F, 3) int64
    texture: NDArray[np.uint8] | None  # (H, W, 3) uint8, or None if the vertices have colours
    uvs: Array | None  # (V, 2) texture coordinates, v upwards; or None
    colours: NDArray[np.uint8] | None  # (V, 3) uint8, or None if there is a texture
    millimetres: float  # length of the unit
    symmetries: Array  # (S, 4, 4) transforms that leave shape and look as they are, the identity first
    # (3,) unit, the axis through the origin of a continuous symmetry; `symmetries` then holds steps
    axis: Array | None
    frame: str  # where origin and axes are, in words

    @property
    def radius(self) -> float:
        """Radius of the enclosing sphere around the origin."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    def mesh(self) -> trimesh.Trimesh:
        """The shape without its colours."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def fade_texture(solid: Solid, strength: float) -> Solid:
    """The same object with what is printed on it shrunk towards its mean colour; at 0 it has that colour alone."""
    if strength == 1:
        return solid
    mean = _colours_all_over(solid).mean(0)

    def fade(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
        faint: NDArray[np.uint8] = (mean + strength * (colours - mean)).round().astype(np.uint8)
        return faint

    return replace(
        solid,
        texture=None if solid.texture is None else fade(solid.texture),
        colours=None if solid.colours is None else fade(solid.colours),
    )


def _colours_all_over(solid: Solid, count: int = 10_000) -> NDArray[np.uint8]:
    """Colours ``(count, 3)`` of points spread evenly over the surface."""
    rng = np.random.default_rng(0)
    a, b, c = solid.vertices[solid.faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners = solid.faces[rng.choice(len(area), count, p=area / area.sum())]
    if solid.texture is None or solid.uvs is None:
        return np.asarray(solid.colours)[corners[:, 0]]
    u, v = np.einsum("nc,ncd->dn", rng.dirichlet(np.ones(3), count), solid.uvs[corners])
    height, width = solid.texture.shape[:2]
    return solid.texture[((1 - v) * height).astype(int) % height, (u * width).astype(int) % width]
