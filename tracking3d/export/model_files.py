"""The object alone: GLB, PLY and STL.

A GLB stands upright, y up, as glTF wants it. PLY and STL are in object coordinates, which the poses are of: y down, z
away from the camera of the first frame; PLY has the colours of its vertices, STL none.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from trimesh.exchange.ply import export_ply
from trimesh.exchange.stl import export_stl

from tracking3d.export.exported_run import ExportedRun
from tracking3d.export.seen_surface import vertex_colours
from tracking3d.results.mesh_export import find_seen_vertices, glb_file


def write_glb(run: ExportedRun, path: Path) -> None:
    """Write the textured mesh, y up, below the nodes ``tracking3d_y_up`` and ``tracking3d_object``."""
    path.write_bytes(glb_file(run.model, unit=run.unit))


def write_ply(run: ExportedRun, path: Path) -> None:
    """Write the mesh in object coordinates, with a colour, a normal and ``seen``, 0 or 1, a vertex."""
    model = run.model
    mesh = trimesh.Trimesh(
        model.vertices,
        model.faces,
        vertex_colors=vertex_colours(model),
        vertex_attributes={"seen": find_seen_vertices(model).astype(np.uint8)},
        process=False,
    )
    path.write_bytes(export_ply(mesh, vertex_normal=True, include_attributes=True))


def write_stl(run: ExportedRun, path: Path) -> None:
    """Write the mesh in object coordinates, without colours."""
    path.write_bytes(export_stl(trimesh.Trimesh(run.model.vertices, run.model.faces, process=False)))
