"""The mesh of what a synthetic clip shows."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import HalfspaceIntersection

from tracking3d.testing.synthesis.convex_clips import SyntheticClip


def mesh_of(clip: SyntheticClip) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices ``(V, 3)`` and faces ``(F, 3)``."""
    planes = np.column_stack([clip.surface.normals, -clip.surface.offsets])
    solid = trimesh.convex.convex_hull(HalfspaceIntersection(planes, np.zeros(3)).intersections)
    return np.asarray(solid.vertices), np.asarray(solid.faces)
