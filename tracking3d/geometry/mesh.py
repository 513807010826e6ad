"""A triangle mesh with texture coordinates, its uniform Laplacian and its normals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from tracking3d.errors import InputError

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Mesh:
    """Fixed topology and atlas; the vertices are the rest shape.

    Attributes:
        vertices: ``(V, 3)`` float64 in object coordinates.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside.
        face_uvs: ``(F, 3, 2)`` float64, one per face corner; v runs down the texture, u wraps at 1.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    face_uvs: NDArray[np.float64]


def uniform_laplacian(faces: Tensor, vertices: int) -> Tensor:
    """Sparse ``(V, V)`` matrix L with ``(L x)_i = x_i - mean of the neighbours of i`` (SoftRas).

    Args:
        faces: ``(F, 3)`` int64.
        vertices: Number of vertices V.
    """
    directed = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = torch.unique(torch.cat([directed, directed.flip(1)]), dim=0)
    degree = torch.bincount(edges[:, 0], minlength=vertices).clamp_min(1)
    diagonal = torch.arange(vertices, device=faces.device)
    index = torch.cat([edges.T, torch.stack([diagonal, diagonal])], 1)
    value = torch.cat([-1.0 / degree[edges[:, 0]], torch.ones(vertices, device=faces.device)])
    return torch.sparse_coo_tensor(index, value, (vertices, vertices), check_invariants=False).coalesce()


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """Unit normals ``(..., V, 3)`` of ``(..., V, 3)``: the faces' normals, averaged by area; differentiable.

    A vertex without a face of positive area has a zero normal.

    Args:
        vertices: ``(..., V, 3)``.
        faces: ``(F, 3)`` int64, counter-clockwise seen from outside.
    """
    a, b, c = (vertices.index_select(-2, corner) for corner in faces.unbind(1))
    weighted = torch.linalg.cross(b - a, c - a)  # twice the area long
    total = torch.zeros_like(vertices)
    for corner in faces.unbind(1):
        total = total.index_add(-2, corner, weighted)
    return functional.normalize(total, dim=-1)


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


# Meshes in glTF, whose y points up: how the object of a run is turned to stand upright, and turned back.
#
# The object's axes are those of the first frame's camera: y down, z away from it. Half a turn about x makes them
# glTF's: y up, and z towards a viewer in front of the object. The turn is a node of its own above the object's, so
# that the mesh itself stays in object coordinates.

UPRIGHT_NODE = "tracking3d_y_up"
OBJECT_NODE = "tracking3d_object"
UNSEEN_MATERIAL = "unseen"
"""Name of the material of the faces that no frame has shown; they have texture coordinates, too."""
UPRIGHT_ROTATION = (1.0, 0.0, 0.0, 0.0)
"""Half a turn about x, as glTF writes it: a quaternion x, y, z, w."""


def read_mesh_file(path: Path) -> trimesh.Trimesh:
    """Read any mesh that trimesh reads, as one piece, with the vertices as the file has them.

    The axes are the file's. Only a ``mesh.glb`` of a run, which knows its object by its name, comes back in
    object coordinates, and so agrees with the ``mesh.obj`` next to it.

    Raises:
        Exception: Whatever trimesh's loaders raise.
    """
    import trimesh  # slow to import

    scene = trimesh.load_scene(path, process=False)
    _share_texture(scene)
    mesh: Any
    places: dict[Any, list[NDArray[np.float64]]] = {}
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph.get(node)
        places.setdefault(name, []).append(T)
    if len(scene.graph.nodes_geometry) > len(places):
        parts = [_instances(scene.geometry[name], np.stack(there)) for name, there in places.items()]
        mesh = trimesh.util.concatenate(parts)
    else:
        mesh = scene.to_mesh()
    if OBJECT_NODE in scene.graph.nodes:
        upright, _ = scene.graph.get(OBJECT_NODE)
        mesh.apply_transform(np.linalg.inv(upright))
    return mesh


def _instances(part: Any, T: NDArray[np.float64]) -> trimesh.Trimesh:
    """A part at several places ``(N, 4, 4)``; trimesh would copy all of it for each, which takes milliseconds."""
    import trimesh  # slow to import

    count, vertices, faces = len(T), np.asarray(part.vertices), np.asarray(part.faces)
    mirrored = np.linalg.det(T[:, :3, :3]) < 0
    wound = np.where(mirrored[:, None, None], faces[:, ::-1], faces)
    made = trimesh.Trimesh(
        (vertices @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]).reshape(-1, 3),
        (wound + len(vertices) * np.arange(count)[:, None, None]).reshape(-1, 3),
        process=False,
    )
    look = part.visual
    if look.kind == "texture":
        made.visual = trimesh.visual.TextureVisuals(np.tile(look.uv, (count, 1)), look.material)
    elif look.kind is not None:
        name = f"{look.kind}_colors"
        setattr(made.visual, name, np.tile(getattr(look, name), (count, 1)))
    return made


def _share_texture(scene: trimesh.Scene) -> None:
    """Give the unseen part of a run's object the material of the seen one; trimesh would merge both textures."""
    parts = [part for part in scene.geometry.values() if hasattr(part.visual, "material")]
    seen = [part for part in parts if part.visual.material.name != UNSEEN_MATERIAL]
    if len(seen) != 1:
        return
    for part in parts:
        part.visual.material = seen[0].visual.material
