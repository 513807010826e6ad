"""A user's mesh file as the object of a sequence."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.geometry.mesh_checks import sound_mesh_file
from tracking3d.testing.synthesis.procedural_texture import plain_colour
from tracking3d_bench.synthesis.solid import Solid
from tracking3d_bench.synthesis.spec import SequenceSpec

_ADVICE = "give a mesh file such as OBJ, PLY, STL or GLB"


def load_solid(path: Path, spec: SequenceSpec) -> Solid:
    """Read any mesh that trimesh reads, with its texture or the colours of its vertices.

    The axes are the file's; the origin moves to the middle of the bounding box. The unit is taken for a metre.

    Raises:
        InputError: If the file is missing, is no mesh, or holds no triangles.
    """
    if not path.is_file():
        raise InputError(f"The mesh '{path}' does not exist; {_ADVICE}.")
    mesh = sound_mesh_file(path, f"The mesh '{path}'", _ADVICE)
    vertices = np.asarray(mesh.vertices, np.float64)
    centre = 0.5 * (vertices.min(0) + vertices.max(0))
    texture, uvs = _texture(mesh) if spec.textured else (None, None)
    colours = None
    if texture is None:
        colours = _colours(mesh, spec)
    where = ", ".join(f"{value:.6g}" for value in centre)
    return Solid(
        vertices - centre,
        np.asarray(mesh.faces, np.int64),
        texture,
        uvs,
        colours,
        1000.0,
        np.eye(4)[None],
        None,
        f"axes of {path.name}, origin at ({where}) of that file",
    )


def _texture(mesh: trimesh.Trimesh) -> tuple[NDArray[np.uint8] | None, NDArray[np.float64] | None]:
    material = getattr(mesh.visual, "material", None)
    uvs = getattr(mesh.visual, "uv", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if uvs is None or image is None or len(uvs) != len(mesh.vertices) or not np.isfinite(uvs).all():
        return None, None
    return np.asarray(image.convert("RGB")), np.asarray(uvs, np.float64)


def _colours(mesh: trimesh.Trimesh, spec: SequenceSpec) -> NDArray[np.uint8]:
    """``(V, 3)``: the file's own if it has some, else one plain colour."""
    if (
        spec.textured
        and isinstance(mesh.visual, trimesh.visual.ColorVisuals)
        and mesh.visual.kind in ("vertex", "face")
    ):
        return np.asarray(mesh.visual.vertex_colors)[:, :3].astype(np.uint8)
    colour = np.array(plain_colour(spec.random("texture").random()), np.uint8)
    return np.tile(colour, (len(mesh.vertices), 1))
