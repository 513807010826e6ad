"""The summary of one run folder for the tables of a batch, and its image for the overview page."""

from __future__ import annotations

import base64
import json
import platform
import posixpath
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from tracking3d.batch.video_job import VideoJob
from tracking3d.results import layout
from tracking3d.results.description import now, time_per_frame
from tracking3d.results.files import write_atomic
from tracking3d.results.overlay import OverlaySize

if TYPE_CHECKING:
    from tracking3d.results.run_reader import RunReader

MARKER = "batch.json"
"""Name of a file in every complete run folder of a batch; on remote storage it is written last."""

FORMAT = "tracking3d-batch-run"
_WIDTH = 200  # pixels of a thumbnail
_QUALITY = 60

COLUMNS = {
    "run": str,
    "video": str,
    "frames": int,
    "tracked": int,
    "uncertain": int,
    "lost": int,
    "skipped": int,
    "confidence": float,
    "iou_initial": float,
    "seconds": float,
    "seconds_per_frame": float,
    "peak_memory_mb": float,
    "tracker": str,
    "attempts": int,
    "machine": str,
    "finished": str,
    "key": str,
    "note": str,
}
"""Columns of the table of results, with one row per run folder, and their types."""


def row_of(run: RunReader, name: str, job: VideoJob, attempts: int = 1, note: str = "") -> dict[str, Any]:
    """One row of the table of results.

    Args:
        run: The run.
        name: What it is called in the batch.
        job: What it is of.
        attempts: How often the video was begun.
        note: A further remark.
    """
    about = run.description
    counts, (per_frame, _) = about["counts"], time_per_frame(about)
    confidences = [record.confidence for record in run.frames]
    return {
        "run": name,
        "video": job.video,
        **{key: counts[key] for key in ("frames", "tracked", "uncertain", "lost", "skipped")},
        "confidence": float(np.mean(confidences)) if confidences else None,
        "iou_initial": about.get("iou_initial_mean"),
        "seconds": about["timings"]["seconds_total"],
        "seconds_per_frame": per_frame,
        "peak_memory_mb": about.get("peak_memory_mb"),
        "tracker": run.config["tracker"]["name"],
        "attempts": attempts,
        "machine": platform.node(),
        "finished": now(),
        "key": job.key,
        "note": note,
    }


def thumbnail(run: RunReader) -> str:
    """The overlay of the frame in the middle, as a small JPEG in base64; empty if there is none."""
    from tracking3d.results.redrawing import overlay_frames
    from tracking3d.ui.report.frame_pictures import jpeg_of

    rows = OverlaySize.of(run.camera).picture
    for image in overlay_frames(run, [len(run.frames) // 2]):
        picture = image[:rows]
        size = (_WIDTH, max(1, round(_WIDTH * picture.shape[0] / picture.shape[1])))
        small = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
        return base64.b64encode(jpeg_of(small, _QUALITY)).decode("ascii")
    return ""


def write_marker(
    folder: Path, job: VideoJob, attempts: int = 1, runs: Sequence[Path] = (), note: str = ""
) -> dict[str, Any]:
    """Write the summary of a finished video into its folder, and return it.

    Args:
        folder: The video's.
        job: The video.
        attempts: How often it was begun.
        runs: The run folders within it; those of its objects if left out.
        note: A further remark on each.

    Raises:
        OutputError: If it cannot be written.
    """
    from tracking3d.results.run_reader import RunReader  # slow to import

    runs = runs or layout.runs_in(folder)
    readers = [RunReader(one) for one in runs]
    names = [posixpath.join(job.name, one.relative_to(folder).as_posix()).removesuffix("/.") for one in runs]
    marker = {
        "format": FORMAT,
        "key": job.key,
        "rows": [row_of(run, name, job, attempts, note) for run, name in zip(readers, names, strict=True)],
        "thumbnails": [thumbnail(run) for run in readers],
    }
    write_atomic(folder / MARKER, json.dumps(marker, indent=1).encode() + b"\n")
    return marker


def read_marker(content: bytes | None) -> dict[str, Any] | None:
    """What `write_marker` wrote; None if there is nothing that can be read."""
    try:
        marker = json.loads(content or b"")
        return marker if marker["format"] == FORMAT else None
    except (ValueError, KeyError, TypeError):
        return None
