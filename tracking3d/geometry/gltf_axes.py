"""Meshes in glTF, whose y points up: how the object of a run is turned to stand upright, and turned back.

The object's axes are those of the first frame's camera: y down, z away from it. Half a turn about x makes them
glTF's: y up, and z towards a viewer in front of the object. The turn is a node of its own above the object's, so
that the mesh itself stays in object coordinates.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

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
    mesh = scene.to_mesh()
    if OBJECT_NODE in scene.graph.nodes:
        upright, _ = scene.graph.get(OBJECT_NODE)
        mesh.apply_transform(np.linalg.inv(upright))
    return mesh


def _share_texture(scene: trimesh.Scene) -> None:
    """Give the unseen part of a run's object the material of the seen one; trimesh would merge both textures."""
    parts = [part for part in scene.geometry.values() if hasattr(part.visual, "material")]
    seen = [part for part in parts if part.visual.material.name != UNSEEN_MATERIAL]
    if len(seen) != 1:
        return
    for part in parts:
        part.visual.material = seen[0].visual.material
