"""Point tracks as JSON and CSV."""

from __future__ import annotations

import csv
import io
import json

from tracking3d.results.correspondences import PointTracks
from tracking3d.results.records import jsonable


def points_to_json(tracks: PointTracks) -> str:
    """One JSON object with the fields of `PointTracks` as nested lists; NaN is null."""
    return json.dumps(jsonable(vars(tracks)), allow_nan=False)


def points_to_csv(tracks: PointTracks) -> str:
    """One row a frame and point: ``frame, point, x, y, visible, on_object``; x and y empty where unknown."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["frame", "point", "x", "y", "visible", "on_object"])
    for row, frame in enumerate(tracks.frames):
        for point, (x, y) in enumerate(tracks.positions[row]):
            place = [f"{x:.3f}", f"{y:.3f}"] if x == x else ["", ""]
            flags = [int(tracks.visible[row, point]), int(tracks.on_object[point])]
            table.writerow([int(frame), point, *place, *flags])
    return text.getvalue()
