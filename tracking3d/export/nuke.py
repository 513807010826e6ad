"""A folder for Nuke: ``camera_moves.chan``, ``object_moves.chan``, and the mesh as ``mesh.obj``.

A line of a ``.chan`` is ``frame tx ty tz rx ry rz``, and of the camera's the vertical field of view after them.
Axes are Nuke's: y up, the camera looks along -z; angles are degrees in the order ZXY, Nuke's default, whose matrix
is Ry Rx Rz. Either the camera moves about the still mesh (``camera_moves.chan``), or a mesh under an axis with
``object_moves.chan`` moves before a camera at the origin; not both. The mesh stands upright, y up. Frames without a
pose have no line. A shifted principal point has no column: it goes into the camera's ``win_translate``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.export.axes import HALF_TURN, inverse
from tracking3d.export.exported_run import ExportedRun
from tracking3d.results.mesh_export import obj_files


def write_nuke(run: ExportedRun, folder: Path) -> None:
    """Write both channels and the mesh."""
    folder.mkdir()
    camera, moving = [], []
    for one in run.poses:
        T_view_mesh = HALF_TURN @ one.T_cam_obj @ HALF_TURN
        angle = 2 * math.degrees(math.atan2(one.camera.height / 2, one.camera.fy))
        moving.append(f"{one.index} {_channels(T_view_mesh)}")
        camera.append(f"{one.index} {_channels(inverse(T_view_mesh))} {angle:.6f}")
    (folder / "object_moves.chan").write_text("\n".join(moving) + "\n", encoding="ascii")
    (folder / "camera_moves.chan").write_text("\n".join(camera) + "\n", encoding="ascii")
    upright = replace(run.model, vertices=run.model.vertices @ HALF_TURN[:3, :3])
    for name, data in obj_files(upright, f"y up, unit: {run.unit}").items():
        (folder / name).write_bytes(data)


def _channels(T: NDArray[np.float64]) -> str:
    """Translation and angles of a pose ``(4, 4)``."""
    ry, rx, rz = Rotation.from_matrix(T[:3, :3]).as_euler("YXZ", degrees=True)
    return " ".join(f"{value:.9f}" for value in (*T[:3, 3], rx, ry, rz))
