"""Surface points followed through the video, as TAP-Vid's arrays and as CSV.

Points are those that were asked for, else a grid over the object in one frame.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.export.exported_run import ExportedRun
from tracking3d.results.correspondences import PointTracks, check_asked, points_to_csv, track_points

_GRID = 100
"""Approximate number of points if none are given."""


def write_points_csv(run: ExportedRun, path: Path) -> None:
    """Write ``frame, point, x, y, visible, on_object``, one row a frame and point, as ``tracking3d points`` does."""
    path.write_text(points_to_csv(_tracks(run)), encoding="ascii")


def write_tapvid(run: ExportedRun, path: Path) -> None:
    """Write an ``.npz`` of plain arrays, for N points in the T frames of the span.

    ``points`` ``(N, T, 2)`` float32 x and y from 0 to 1 across the frame, as TAP-Vid's DAVIS has them; ``occluded``
    ``(N, T)`` bool; ``query_points`` ``(N, 3)`` row of the frame, y and x; ``frames`` ``(T,)`` indices in the source.
    Where a point is not known, in a frame that is lost or was skipped, it is occluded and 0.
    """
    tracks = _tracks(run)
    row_of = {index: row for row, index in enumerate(run.span)}
    size = np.array([run.camera.width, run.camera.height])
    positions = np.zeros((len(tracks.query), len(run.span), 2), np.float32)
    occluded = np.ones(positions.shape[:2], bool)
    rows = [row_of[int(index)] for index in tracks.frames]
    # TAP-Vid counts from the outer corner of the first pixel.
    positions[:, rows] = np.nan_to_num((tracks.positions + 0.5) / size).transpose(1, 0, 2)
    occluded[:, rows] = ~tracks.visible.T
    asked = (tracks.query + 0.5) / size
    query = np.column_stack([np.full(len(asked), row_of[tracks.query_frame]), asked[:, ::-1]])
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            points=positions,
            occluded=occluded,
            query_points=query.astype(np.float32),
            frames=np.array(run.span),
        )


def _tracks(run: ExportedRun) -> PointTracks:
    frame = run.poses[0].index if run.options.frame is None else run.options.frame
    if frame not in run.records:
        raise InputError(f"The run {run.reader.folder} has no frame {frame}; choose one of its frames.")
    asked = run.options.xy or None
    xy = np.array(asked, dtype=float) if asked else _grid(run, frame)
    tracks = track_points(run.reader, frame, xy)
    check_asked(tracks, run.camera)
    return tracks


def _grid(run: ExportedRun, frame: int) -> NDArray[np.float64]:
    """Pixels ``(N, 2)`` evenly over the mask of a frame, not quite up to its outline.

    Raises:
        InputError: If the mask is empty.
    """
    mask = run.mask(frame)
    step = max(round(math.sqrt(np.count_nonzero(mask) / _GRID)), 1)
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    grid = np.zeros_like(mask)
    grid[step // 2 :: step, step // 2 :: step] = True
    rows, columns = np.nonzero(grid & (depth > min(step / 2, depth.max() / 2)))
    if not len(rows):
        raise InputError(f"The mask of frame {frame} of {run.reader.folder} is empty; choose another frame.")
    return np.column_stack([columns, rows]).astype(float)
