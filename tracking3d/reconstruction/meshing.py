"""The surface of a signed distance volume as a mesh: closed, in one piece, simple, and with an atlas."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import affine_transform

if TYPE_CHECKING:
    import trimesh

_log = logging.getLogger(__name__)
SMALLEST_PIECE = 0.1
"""Share of the largest piece's volume below which a piece is a crumb."""


CELL = 8
"""Texels along the side of a cell of the `cell_atlas`."""


def extract_surface(grid: Grid, inside: FloatArray) -> trimesh.Trimesh | None:
    """The surface where the volume is zero; None if it is nowhere, or leaves the grid.

    Args:
        grid: Grid of the volume.
        inside: ``(X * Y * Z,)`` signed distance, positive inside.
    """
    import trimesh  # slow to import, and only needed at the end
    from skimage.measure import marching_cubes

    volume = np.full(np.add(grid.shape, 2), -abs(float(inside.min())) - grid.spacing, np.float32)
    volume[1:-1, 1:-1, 1:-1] = inside.reshape(grid.shape)
    if not (volume > 0).any():
        return None
    vertices, faces, _, _ = marching_cubes(volume, 0.0, allow_degenerate=False)
    mesh = trimesh.Trimesh(grid.origin + grid.spacing * (vertices - 1.0), faces, process=True)
    return mesh if mesh.volume > 0 else trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def main_pieces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The largest piece, and others that are no crumbs; cavities within it are filled."""
    import trimesh  # slow to import

    pieces = mesh.split(only_watertight=True)
    solid = [piece for piece in pieces if piece.volume > 0]
    if not solid:
        return mesh
    largest = max(piece.volume for piece in solid)
    kept = [piece for piece in solid if piece.volume >= SMALLEST_PIECE * largest]
    whole = trimesh.util.concatenate(kept)
    assert isinstance(whole, trimesh.Trimesh)
    return whole


def is_sound(mesh: trimesh.Trimesh) -> bool:
    """Whether a mesh is closed, oriented alike everywhere, with its outside outside."""
    return bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)


def simplify(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """With about so many faces at most; with more if fewer would tear it."""
    while faces < len(mesh.faces):
        simple = decimate_roughly(mesh, faces)
        if is_sound(simple):
            return simple
        faces *= 2
    return mesh


def decimate_roughly(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    """With about so many faces at most, sound or not."""
    import fast_simplification
    import trimesh  # slow to import

    if faces >= len(mesh.faces):
        return mesh
    vertices, triangles = fast_simplification.simplify(
        np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32), target_count=faces
    )
    simple = trimesh.Trimesh(vertices.astype(np.float64), triangles, process=True)
    simple.update_faces(simple.nondegenerate_faces())
    return simple


def cell_atlas(faces: int) -> tuple[NDArray[np.float64], int]:
    """Texture coordinates ``(F, 3, 2)`` with a cell for every two faces, and the texels that they need along a side.

    Quickly made, for colours that are compared and not looked at.
    """
    across = max(int(np.ceil(np.sqrt((faces + 1) // 2))), 1)
    number = np.arange(faces)
    cell = np.stack([number // 2 % across, number // 2 // across], 1)[:, None]
    low, high = 0.75 / CELL, 1 - 0.75 / CELL
    first = np.array([[low, low], [low, high - 1 / CELL], [high - 1 / CELL, low]])
    corners = np.where((number % 2 == 0)[:, None, None], first, 1 - first)
    return (cell + corners) / across, across * CELL


def unwrap(vertices: NDArray[np.float64], faces: NDArray[np.int64], size: int = 1024) -> NDArray[np.float64]:
    """``(F, 3, 2)`` texture coordinates of the face corners, v downwards, in charts apart from each other.

    xatlas has no wheel for every system; without it, which is told, each two faces are a chart (`cell_atlas`).
    """
    try:
        import xatlas
    except ImportError:
        _log.warning(
            "xatlas is not installed (some systems have no wheel): each two faces of the mesh have a piece of the "
            "texture of their own, which is hard to paint on. Install it, and run `tracking3d model`."
        )
        return cell_atlas(len(faces))[0]

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.padding, pack.resolution, pack.bilinear = 2, size, True
    atlas.generate(pack_options=pack)
    vertex, corner, uv = atlas[0]
    if not np.array_equal(vertex[corner], faces):
        raise ValueError("the atlas has other faces than the mesh")
    return np.asarray(uv, np.float64)[corner]


FloatArray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Grid:
    """Voxel centres at ``origin + spacing * (i, j, k)``, in object coordinates."""

    origin: NDArray[np.float64]  # (3,) the first centre
    spacing: float  # between centres
    shape: tuple[int, int, int]  # number of centres along x, y and z

    @classmethod
    def around(cls, points: NDArray[np.float64], cells: int, margin: float) -> Grid:
        """The grid around ``points`` ``(N, 3)``.

        Args:
            points: What it has to hold.
            cells: Along the longest side of the points' box.
            margin: Free space around that box on every side, relative to its longest side.
        """
        low, high = points.min(0), points.max(0)
        longest = float((high - low).max())
        spacing = longest / cells
        padding = margin * longest + 2 * spacing
        x, y, z = np.ceil((high - low + 2 * padding) / spacing).astype(int) + 1
        return cls(low - padding, spacing, (int(x), int(y), int(z)))

    def around_centres(self, kept: NDArray[np.bool_], spacing: float) -> Grid:
        """The grid of another spacing that reaches one step of this one beyond its centres ``(X * Y * Z,)`` kept."""
        at = np.argwhere(kept.reshape(self.shape))
        low, high = (at.min(0) - 1, at.max(0) + 1) if len(at) else (0, np.array(self.shape) - 1)
        x, y, z = np.ceil((high - low) * self.spacing / spacing).astype(int) + 1
        return Grid(self.origin + self.spacing * low, spacing, (int(x), int(y), int(z)))

    def resample(self, values: FloatArray, other: Grid) -> FloatArray:
        """``(N,)`` values at this grid's centres, interpolated linearly at the centres of another grid."""
        first, step = (other.origin - self.origin) / self.spacing, other.spacing / self.spacing
        volume, steps = values.reshape(self.shape), [step] * 3
        found = affine_transform(volume, steps, first, other.shape, np.float32, order=1, mode="nearest")
        return np.asarray(found.ravel())

    @cached_property
    def points(self) -> FloatArray:
        """``(X * Y * Z, 3)`` centres; z runs fastest."""
        axes = [self.origin[axis] + self.spacing * np.arange(count) for axis, count in enumerate(self.shape)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), 3).reshape(-1, 3).astype(np.float32)
