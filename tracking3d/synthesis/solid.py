"""An object of a synthetic sequence: shape, colours, symmetries."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solid:
    """An object in its own coordinates.

    Attributes:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)`` int64.
        texture: ``(H, W, 3)`` uint8, or None where the vertices have colours.
        uvs: ``(V, 2)`` texture coordinates, v upwards; or None.
        colours: ``(V, 3)`` uint8, or None where there is a texture.
        millimetres: Length of the unit.
        symmetries: ``(S, 4, 4)`` transforms that leave shape and look as they are, the identity first.
        axis: ``(3,)`` unit, the axis through the origin of a continuous symmetry; `symmetries` then holds steps.
        frame: Where origin and axes are, in words.
    """

    vertices: Array
    faces: NDArray[np.int64]
    texture: NDArray[np.uint8] | None
    uvs: Array | None
    colours: NDArray[np.uint8] | None
    millimetres: float
    symmetries: Array
    axis: Array | None
    frame: str

    @property
    def radius(self) -> float:
        """Radius of the enclosing sphere around the origin."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    def mesh(self) -> trimesh.Trimesh:
        """The shape without its colours."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)
