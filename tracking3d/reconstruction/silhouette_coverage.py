"""Where a shape has to be larger, since views show the object where it is not.

A shape that is too small leaves pixels of the masks uncovered. A voxel that is within the visual hull, and that several
views see at such pixels, is likely to be part of the object.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.reconstruction.grid import FloatArray, Grid
from tracking3d.reconstruction.meshing import decimate_roughly, extract_surface
from tracking3d.reconstruction.plane_sweep import Guide
from tracking3d.reconstruction.shape_views import ShapeView

LEAST_VIEWS = 3
"""Views that have to see a voxel at a pixel of the object that the shape does not cover."""
_TOLERANCE = 2  # pixels around the shape's silhouette that count as covered
_FACES = 6000


def restore_uncovered(
    grid: Grid, hull: FloatArray, shape: FloatArray, views: Sequence[ShapeView]
) -> FloatArray:
    """A shape's signed distance, with that of the hull where views show the object and the shape is too small.

    Args:
        grid: Where.
        hull: ``(N,)`` signed distance from the visual hull, positive inside.
        shape: ``(N,)`` from the shape, positive inside.
        views: The frames.

    Returns:
        ``(N,)``.
    """
    found = extract_surface(grid, np.minimum(hull, shape))
    if found is None:
        return hull
    mesh = decimate_roughly(found, _FACES)
    guide = Guide(np.asarray(mesh.vertices), np.ascontiguousarray(mesh.faces, np.int64))
    asked = np.flatnonzero((hull > 0) & (shape <= 0))
    points = grid.points[asked]
    votes = np.zeros(len(asked), int)
    for view in views:
        uncovered = _uncovered_pixels(guide, view)
        if uncovered.any():
            x, y, z = view.P[:, :3].astype(np.float32) @ points.T + view.P[:, 3:].astype(np.float32)
            z = np.maximum(z, 1e-6)
            pixel = np.rint(np.stack([y, x]) / z)
            inside = ((pixel >= 0) & (pixel < len(uncovered))).all(0)
            row, column = pixel[:, inside].astype(int)
            votes[inside] += uncovered[row, column]
    restored = shape.copy()
    missing = asked[votes >= LEAST_VIEWS]
    restored[missing] = hull[missing]
    return restored


def _uncovered_pixels(guide: Guide, view: ShapeView) -> NDArray[np.bool_]:
    """``(S, S)`` the pixels of a view's mask that a surface leaves uncovered, more than a few pixels off."""
    depth, _ = guide.visible_to(view)
    around = np.ones((2 * _TOLERANCE + 1,) * 2, np.uint8)
    return view.mask & (cv2.dilate(np.isfinite(depth).astype(np.uint8), around) == 0)
