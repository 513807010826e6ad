"""The part of a true surface that is visible in a clip."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from tracking3d.geometry.camera import Camera
from tracking3d_bench.evaluation.vsd import model_depth

MOST = 40
"""Frames that are asked, spread evenly over the clip."""
_TOLERANCE = 0.01
"""How far behind what is drawn a point may lie and still be seen, in diameters."""


def make_visibility_test(
    mesh: trimesh.Trimesh, diameter: float, T_cam_obj: Sequence[NDArray[np.float64]], camera: Camera
) -> Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.bool_]]:
    """A function that says of points ``(N, 3)`` on the surface with normals ``(N, 3)`` which any frame shows.

    Things that stand before the object are not known of.

    Args:
        mesh: The true shape.
        diameter: Its diameter.
        T_cam_obj: ``(4, 4)`` true pose of each frame; those that are not finite show nothing.
        camera: Camera of all frames.
    """
    whole = [pose for pose in T_cam_obj if np.isfinite(pose).all()]
    poses = [whole[n] for n in np.unique(np.linspace(0, len(whole) - 1, MOST).astype(int))] if whole else []

    def seen(points: NDArray[np.float64], normals: NDArray[np.float64]) -> NDArray[np.bool_]:
        shown = np.zeros(len(points), np.bool_)
        for pose in poses:
            drawn = model_depth(mesh.vertices, mesh.faces, pose, camera.K, (camera.width, camera.height))
            deepest = np.max([np.roll(drawn, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], 0)
            x = points @ pose[:3, :3].T + pose[:3, 3]
            with np.errstate(divide="ignore", invalid="ignore"):
                column, row = (x @ camera.K.T)[:, :2].T / x[:, 2]
                inside = (x[:, 2] > 0) & (column >= 0) & (column <= camera.width - 1)
                inside &= (row >= 0) & (row <= camera.height - 1)
            at = (
                np.rint(np.where(inside, row, 0)).astype(int),
                np.rint(np.where(inside, column, 0)).astype(int),
            )
            facing = ((normals @ pose[:3, :3].T) * x).sum(1) < 0
            shown |= inside & facing & (x[:, 2] < deepest[at] + _TOLERANCE * diameter)
        return shown

    return seen
