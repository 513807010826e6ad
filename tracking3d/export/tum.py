"""Trajectories in the TUM format: ``timestamp tx ty tz qx qy qz qw`` in each line.

Frames without a pose have no line. Timestamps are seconds since the start of the source; if unknown, frame
indices. https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats
"""

from __future__ import annotations

from pathlib import Path

from tracking3d.export.axes import inverse, quaternion
from tracking3d.export.exported_run import ExportedRun

_TITLES = {
    "object": "T_cam_obj: the object in the camera's axes (OpenCV: x right, y down, z forward)",
    "camera": "T_obj_cam: the camera in the object's axes; its own are OpenCV's (x right, y down, z forward)",
}


def write_tum(run: ExportedRun, path: Path) -> None:
    """Write the trajectory of the object, or of the camera about it."""
    timed = all(one.seconds is not None for one in run.poses)
    clock = "seconds since the start of the source" if timed else "frame indices"
    lines = [f"# {_TITLES[run.options.of]}", f"# timestamps: {clock}; unit of length: {run.unit}"]
    lines.append("# timestamp tx ty tz qx qy qz qw")
    for one in run.poses:
        T = one.T_cam_obj if run.options.of == "object" else inverse(one.T_cam_obj)
        w, x, y, z = quaternion(T)
        time = f"{one.seconds:.6f}" if timed else str(one.index)
        lines.append(" ".join([time, *(f"{value:.9f}" for value in (*T[:3, 3], x, y, z, w))]))
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
