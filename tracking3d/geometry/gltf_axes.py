"""Meshes in glTF, whose y points up: how the object of a run is turned to stand upright, and turned back.

The object's axes are those of the first frame's camera: y down, z away from it. Half a turn about x makes them
glTF's: y up, and z towards a viewer in front of the object. The turn is a node of its own above the object's, so
that the mesh itself stays in object coordinates.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import trimesh

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
