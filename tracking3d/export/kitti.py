"""Poses in the format of KITTI's odometry benchmark: a folder with ``poses.txt``, ``calib.txt`` and ``times.txt``.

A line of ``poses.txt`` holds the upper three rows of a pose, row by row. Lines have no number: line n is frame n of
those that were asked for, and a frame without a pose is a line of ``nan``. ``calib.txt`` has the projection of the
camera as P0 to P3, ``times.txt`` seconds, if they are known. https://www.cvlibs.net/datasets/kitti/eval_odometry.php
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tracking3d.export.axes import inverse
from tracking3d.export.exported_run import ExportedRun


def write_kitti(run: ExportedRun, folder: Path) -> None:
    """Write poses of the object, or of the camera about it, and the camera."""
    folder.mkdir()
    poses = {one.index: one.T_through(run.camera) for one in run.poses}
    unknown = np.full((4, 4), np.nan)
    lines = []
    for index in run.span:
        T = poses.get(index, unknown)
        lines.append(_numbers(T if run.options.of == "object" else inverse(T)))
    (folder / "poses.txt").write_text("\n".join(lines) + "\n", encoding="ascii")
    projection = _numbers(np.column_stack([run.camera.K, np.zeros(3)]))
    calibration = "".join(f"P{number}: {projection}\n" for number in range(4))
    (folder / "calib.txt").write_text(calibration, encoding="ascii")
    times = [run.seconds(index) for index in run.span]
    if None not in times:
        text = "".join(f"{seconds:.6e}\n" for seconds in times)
        (folder / "times.txt").write_text(text, encoding="ascii")


def _numbers(T: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.9e}" for value in T[:3].ravel())
