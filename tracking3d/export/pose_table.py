"""Poses as a table, CSV or Parquet: one row per frame, with all scalar values of the run.

Columns: ``index``, ``seconds``, ``name``, ``status``, ``confidence``; ``tx``, ``ty``, ``tz`` and ``qw``, ``qx``,
``qy``, ``qz`` of ``T_cam_obj``; ``fx``, ``fy``, ``cx``, ``cy`` of the camera that the pose is of; ``area`` of the
mask. Frames that are lost have a row with an empty pose; frames that were skipped have none.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

from tracking3d.estimation.estimate import FREE_ROTATION
from tracking3d.export.axes import quaternion
from tracking3d.export.exported_run import ExportedRun

POSE = ("tx", "ty", "tz", "qw", "qx", "qy", "qz")
_TEXT = {"name", "status"}
_WHOLE = {"index", "area"}


def pose_rows(run: ExportedRun) -> list[dict[str, Any]]:
    """The rows; None stands for what is not known."""
    posed = {one.index: one for one in run.poses}
    rows = []
    for index, record in run.records.items():
        camera = run.reader.camera_of(record)
        place: list[float | None] = [None] * len(POSE)
        if index in posed:
            T = posed[index].T_cam_obj
            place = [float(value) for value in (*T[:3, 3], *quaternion(T))]
        rows.append(
            {
                "index": index,
                "seconds": run.seconds(index),
                "name": record.name,
                "status": str(record.status),
                "confidence": record.confidence if math.isfinite(record.confidence) else None,
                **dict(zip(POSE, place, strict=True)),
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "area": record.area,
            }
        )
    return rows


def write_csv(run: ExportedRun, path: Path) -> None:
    """Write the table as CSV; what is not known is empty."""
    rows = pose_rows(run)
    text = io.StringIO()
    table = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    path.write_text(text.getvalue(), encoding="utf-8")


def write_parquet(run: ExportedRun, path: Path) -> None:
    """Write the table as Parquet; what is not known is null. Its metadata says axes and unit."""
    import pyarrow
    import pyarrow.parquet

    rows = pose_rows(run)
    kinds = {name: pyarrow.string() for name in _TEXT} | {name: pyarrow.int64() for name in _WHOLE}
    schema = pyarrow.schema(
        [(name, kinds.get(name, pyarrow.float64())) for name in rows[0]],
        metadata={"unit": run.unit, "axes": "OpenCV: x right, y down, z forward", "pose": "T_cam_obj"}
        | ({"free_axis": str(list(run.free_axis)), "note": FREE_ROTATION} if run.free_axis else {}),
    )
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), path)
