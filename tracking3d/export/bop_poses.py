"""Poses in the format of the BOP Challenge: ``scene_id,im_id,obj_id,score,R,t,time``, one row a frame.

Lengths are in millimetres; if the size of the object is not known, one unit of the run is taken for a metre. Frames
without a pose have no row. Scene and object are number 1, images are numbered by frame index.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

from tracking3d.export.exported_run import ExportedRun

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
MILLIMETRES = 1000.0


def write_bop_poses(run: ExportedRun, path: Path) -> None:
    """Write the table; ``time`` is what the estimate took, -1 if unknown."""
    with path.open("w", encoding="ascii", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        for one in run.poses:
            R, t = one.T_cam_obj[:3, :3].ravel(), MILLIMETRES * one.T_cam_obj[:3, 3]
            score = one.record.confidence if math.isfinite(one.record.confidence) else 0.0
            seconds = one.record.seconds if one.record.seconds > 0 else -1.0
            numbers = [" ".join(f"{value:.9g}" for value in values) for values in (R, t)]
            table.writerow([1, one.index, 1, f"{score:.6g}", *numbers, f"{seconds:.6g}"])
