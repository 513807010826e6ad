"""The contents of ``run.json``: how a run was made and what came of it."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import cv2
import numpy as np

from tracking3d.estimation.estimate import Status
from tracking3d.geometry.camera import Camera
from tracking3d.process_memory import resident_memory
from tracking3d.results.layout import CONVENTIONS, FORMAT, FORMAT_VERSION
from tracking3d.results.records import FrameRecord

MOST_FAILURES = 20
"""Different reasons of plug-in failures that a summary lists; the commonest come first."""


def description_at_start(
    *,
    config: dict[str, Any],
    camera: Camera,
    source: str,
    seed: int,
    fps: float | None,
    command: str | None,
    selection: str | None,
    renderer: Mapping[str, str | int] | None,
) -> dict[str, Any]:
    """What is known of a run before its first frame."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "state": "running",
        "error": None,
        "created": now(),
        "finished": None,
        "source": source,
        "selection": selection,
        "fps": fps,
        "command": command,
        "seed": seed,
        "config": config,
        "camera": asdict(camera),
        "renderer": renderer,
        "versions": versions(),
        "conventions": CONVENTIONS,
        "skipped": [],
    }


def summary(records: Sequence[FrameRecord], skipped: int, seconds: float) -> dict[str, Any]:
    """Counts, plug-in failures, timings, mean IoU and highest memory of a run.

    Args:
        records: The answer for every frame.
        skipped: Number of frames that could not be decoded.
        seconds: Wall time of the whole run.
    """
    by_status = Counter(record.status for record in records)
    per_frame = [record.seconds for record in records]
    memory = resident_memory()
    failures = Counter(record.failure for record in records if record.failure)
    ious = [record.iou_initial for record in records if record.iou_initial is not None]
    return {
        "counts": {
            "frames": len(records),
            **{status.value: by_status[status] for status in Status},
            "keyframes": sum(record.keyframe for record in records),
            "skipped": skipped,
            "failed": failures.total(),
        },
        "failures": [
            {"reason": reason, "frames": frames} for reason, frames in failures.most_common(MOST_FAILURES)
        ],
        "timings": {
            "seconds_total": seconds,
            "seconds_per_frame_mean": float(np.mean(per_frame)) if per_frame else None,
            "seconds_per_frame_median": float(np.median(per_frame)) if per_frame else None,
        },
        "iou_initial_mean": float(np.mean(ious)) if ious else None,
        "peak_memory_mb": memory and memory[1],
    }


def versions() -> dict[str, str | None]:
    """Versions of what a result depends on."""
    packages = {name: _version(name) for name in ("tracking3d", "torch", "kornia", "numba", "numpy")}
    return packages | {
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
    }


def now() -> str:
    """The time in UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
