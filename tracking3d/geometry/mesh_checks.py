"""What a mesh that somebody made has to be before anything is computed with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tracking3d.errors import InputError
from tracking3d.geometry.gltf_axes import read_mesh_file

if TYPE_CHECKING:
    import trimesh

FARTHEST = 1e9
"""No vertex lies farther out, in whatever unit; beyond, squares and products of coordinates lose all digits."""
SMALLEST = 1e-9
"""No mesh is smaller."""
MOST_FACES = 5_000_000
"""And none has more faces."""


def sound_mesh_file(path: Path, named: str, advice: str) -> trimesh.Trimesh:
    """Read a mesh file that can be computed with.

    Args:
        path: The file.
        named: What the sentence of an error calls it.
        advice: How that sentence ends.

    Raises:
        InputError: If it cannot be read, or for `what_is_wrong`.
    """
    try:
        mesh = read_mesh_file(path)
    except Exception as error:  # trimesh raises whatever its loaders raise
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ImportError):  # for text in another encoding it would like a further library
            reason = "its text is damaged"
        raise InputError(f"{named} cannot be read as a mesh ({reason}); {advice}.") from error
    if wrong := what_is_wrong(mesh):
        raise InputError(f"{named} {wrong}; {advice}.")
    return mesh


def what_is_wrong(mesh: object) -> str:
    """Why a mesh that was read cannot be used, as the end of a sentence that begins with it; empty if it can.

    Args:
        mesh: What trimesh made of a file.
    """
    import trimesh  # slow to import

    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces) or not len(mesh.vertices):
        return "holds no triangles"
    if np.shape(mesh.vertices)[1:] != (3,) or np.shape(mesh.faces)[1:] != (3,):
        return "has positions that are not three numbers each"
    if not np.isfinite(mesh.vertices).all():
        return "has vertices that are not finite"
    farthest = float(np.abs(mesh.vertices).max())
    if farthest > FARTHEST:
        return f"has a vertex at {farthest:.3g}, which is too far out for any object"
    if np.ptp(mesh.vertices, axis=0).max() < SMALLEST:
        return "has all its vertices at one point"
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        return f"has faces of vertices that it has not ({mesh.faces.max() + 1} of {len(mesh.vertices)})"
    if len(mesh.faces) > MOST_FACES:
        return f"has {len(mesh.faces):,} faces, and more than {MOST_FACES:,} are too many; simplify it"
    return ""
