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


COLUMNS = [
    "frame",
    "point",
    "x",
    "y",
    "visible",
    "on_object",
    "uncertainty",
    "measured",
    "X",
    "Y",
    "Z",
    "kind",
]


def points_to_csv(tracks: PointTracks) -> str:
    """One row a frame and point, with the columns `COLUMNS`.

    x, y and uncertainty are pixels, X, Y and Z object coordinates; empty if they are unknown. ``kind`` says by
    what a point is followed, see `PointKind`.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    places = [[_number(value, 5) for value in point] for point in tracks.points]
    for row, frame in enumerate(tracks.frames):
        for point, (x, y) in enumerate(tracks.positions[row]):
            flags = [int(tracks.visible[row, point]), int(tracks.on_object[point])]
            unsure = _number(tracks.uncertainty[row, point], 3)
            place = [_number(x, 3), _number(y, 3)]
            measured = int(tracks.measured[row, point])
            table.writerow(
                [int(frame), point, *place, *flags, unsure, measured, *places[point], tracks.kind[point]]
            )
    return text.getvalue()


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if value == value else ""
