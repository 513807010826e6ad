"""A movie of the model on a turntable, drawn by our own renderer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.estimate import ObjectModel
from tracking3d.results.layout import partial_path
from tracking3d.results.mesh_view import render_view, texture_of_views
from tracking3d.runtime.progress import report_each
from tracking3d.video.writer import VideoWriter

VIEWS = 48
FPS = 12.0
SIDE = 320
PITCH = 20.0
"""Degrees by which the views look down on the object."""


def write_turntable(path: Path, model: ObjectModel, rotation: NDArray[np.float64]) -> None:
    """Write one turn of the model about the vertical of a view; what was never seen is pale.

    Args:
        path: The MP4 file; it is there when it is whole.
        model: The object.
        rotation: ``(3, 3)`` object to camera of the first view.

    Raises:
        OutputError: If it cannot be written.
    """
    partial, texture = partial_path(path), texture_of_views(model, SIDE)
    try:
        with VideoWriter(partial, FPS, (SIDE, SIDE)) as video:
            for yaw in report_each("turntable", np.arange(VIEWS) * 360.0 / VIEWS):
                turned = Rotation.from_euler("yx", [yaw, PITCH], degrees=True).as_matrix() @ rotation
                video.write(render_view(model, turned, SIDE, texture))
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
