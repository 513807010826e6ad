"""Which vertices of a surface were ever seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from tracking3d.reconstruction.plane_sweep import Guide
from tracking3d.scene.view import ObjectView


def seen_vertices(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], views: Sequence[ObjectView]
) -> NDArray[np.bool_]:
    """``(V,)`` whether any of the views shows a vertex.

    Args:
        vertices: ``(V, 3)``.
        faces: ``(F, 3)``.
        views: The frames.
    """
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    tolerance = 0.01 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    seen = np.zeros(len(vertices), np.bool_)
    for view in views:
        drawn, _ = Guide(vertices, faces).visible_to(view)
        x, y, z = view.P[:, :3] @ vertices.T + view.P[:, 3:]
        column, row = np.rint(x / z).astype(int), np.rint(y / z).astype(int)
        inside = (z > 0) & (column >= 0) & (column < len(drawn)) & (row >= 0) & (row < len(drawn))
        eye = -view.T_cam_obj[:3, :3].T @ view.T_cam_obj[:3, 3]
        front = (mesh.vertex_normals * (eye - vertices)).sum(1) > 0
        at = row.clip(0, len(drawn) - 1), column.clip(0, len(drawn) - 1)
        seen |= inside & front & (z < drawn[at] + tolerance)
    return seen
