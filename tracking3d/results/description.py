"""The contents of ``run.json``: the settings and the outcome of a run."""

from __future__ import annotations

import os
import platform
import re
import socket
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import cv2
import numpy as np
import psutil

from tracking3d.estimation.estimate import MaskSource, Status
from tracking3d.geometry.camera import Camera
from tracking3d.results.layout import ARBITRARY, CONVENTIONS, FORMAT, FORMAT_VERSION
from tracking3d.results.records import FrameRecord
from tracking3d.runtime.memory import resident_memory
from tracking3d.runtime.stage_times import StageTimes

MOST_FAILURES = 20
"""Different reasons of plug-in failures that a summary lists; the commonest come first."""


@dataclass(frozen=True, eq=False, kw_only=True)
class RunHeader:
    """The facts of a run before its first frame, as ``run.json`` names and orders them."""

    source: str  # the tracked video, in words
    selection: str | None = None  # the START:STOP:STEP that the source was opened with
    # the identity of source and prompt, see `tracking3d.results.checkpoint.resuming.prompt_record`
    prompt: Mapping[str, Any] | None = None
    fps: float | None  # frames per second of the source, if known
    command: str | None  # the command line, if there was one
    source_notes: Sequence[str] = ()  # how the source processed its images, in clauses
    seed: int  # seed of everything random
    config: dict[str, Any]  # the configuration as used
    tracker_choice: str | None = None  # why auto chose the mask tracker of config; None if the user named it
    camera: Camera  # the camera of the full frame
    renderer: Mapping[str, str | int] | None = None  # what renders, and why


def for_new_folder(command: str) -> str:
    """The command line of a run without what it does about an earlier run in its folder."""
    return re.sub(" --(overwrite|resume)(?= |$)", "", command)


def description_at_start(header: RunHeader) -> dict[str, Any]:
    """The contents of ``run.json`` before the first frame."""
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "state": "running",
        "error": None,
        "created": now(),
        "finished": None,
        "process": this_process(),
        "resumed": [],
        **vars(header),
        "source_notes": list(header.source_notes),
        "camera": asdict(header.camera),
        "versions": versions(),
        "conventions": CONVENTIONS,
        "unit": {"name": ARBITRARY},
        "refinement": None,
        "skipped": [],
    }


@dataclass(frozen=True)
class StartOfModel:
    """Where the model that is refined started."""

    frame: int  # index of the frame
    reason: str  # why it started there, in words
    advice: str = ""  # of photos: which could not be joined, and what to do; empty if all were
    # how many frames were tried once more because the object was lost, by what
    tried: Mapping[str, int] = field(default_factory=dict)


def refinement(
    state: str,
    reason: str = "",
    causal: Sequence[FrameRecord] = (),
    refined: Sequence[FrameRecord] = (),
    seconds: float = 0.0,
    together: StageTimes | None = None,
    kept: int = 0,
    start: StartOfModel | None = None,
    passed_over: Mapping[str, int] | None = None,
) -> dict[str, Any]:
    """The outcome of a final refinement.

    Args:
        state: ``running``, ``finished``, ``interrupted``, ``failed`` or ``skipped``.
        reason: Why it has that state, in words.
        causal: The causal estimate for every frame.
        refined: The refined estimates.
        seconds: Wall time it took.
        together: Times of the global refinement of the map, before the frames.
        kept: Number of refined estimates that are those of the run before its last correction.
        start: Where the refined model started; None until that is decided.
        passed_over: How many frames each pass has left as they were, by its name.
    """
    return {
        "state": state,
        "reason": reason,
        "start": None
        if start is None
        else {key: value for key, value in asdict(start).items() if value not in ("", {})},
        "frames": len(refined),
        "kept_causal": len(causal) - len(refined),
        "kept_refined": kept if refined else 0,
        "passed_over": dict(passed_over or {}) if refined else {},
        "seconds": seconds,
        "stages": _plain(stages_of(refined), together),
        "causal": {**_by_status(causal), "iou_initial_mean": _mean_iou(causal)},
    }


def summary(
    records: Sequence[FrameRecord],
    skipped: int,
    passes: Mapping[str, float],
    causal: Sequence[FrameRecord] | None = None,
) -> dict[str, Any]:
    """Counts, plug-in failures, timings, mean IoU, where masks come from and highest memory of a run.

    Args:
        records: The estimate for every frame.
        skipped: Number of frames that could not be decoded.
        passes: Wall time of the run by pass.
        causal: The causal estimates, whose seconds are the run's; ``records`` themselves if None.
    """
    causal = records if causal is None else causal
    per_frame = [record.seconds for record in causal]
    own = [record for record in records if record.mask_source is not None and record.mask_source.is_own]
    failures = Counter(record.failure for record in records if record.failure)
    return {
        "counts": {
            "frames": len(records),
            **_by_status(records),
            "keyframes": sum(record.keyframe for record in records),
            "skipped": skipped,
            "failed": failures.total(),
            "masks": {
                source.value: sum(record.mask_source is source for record in records) for source in MaskSource
            },
        },
        "failures": [
            {"reason": reason, "frames": frames} for reason, frames in failures.most_common(MOST_FAILURES)
        ],
        "timings": {
            "seconds_total": sum(passes.values()),
            "passes": dict(passes),
            "seconds_per_frame_mean": float(np.mean(per_frame)) if per_frame else None,
            "seconds_per_frame_median": float(np.median(per_frame)) if per_frame else None,
            "stages": _plain(stages_of(causal)),
        },
        "iou_initial_mean": _mean_iou(records),
        "iou_initial_mean_own": _mean_iou(own),
        "peak_memory_mb": resident_memory()[1],
    }


def stages_of(records: Sequence[FrameRecord]) -> StageTimes | None:
    """Times of all records together, stage by stage; None if one has none."""
    stages = [record.stages for record in records if record.stages is not None]
    return sum(stages, StageTimes()) if len(stages) == len(records) else None


def time_per_frame(run: Mapping[str, Any]) -> tuple[float | None, StageTimes | None]:
    """Mean time of a frame of a run that is over, with the final refinement, and its stages.

    Args:
        run: Its ``run.json``.
    """
    timings, refinement, frames = run["timings"], run.get("refinement") or {}, run["counts"]["frames"]
    whole, stages = timings["seconds_per_frame_mean"], timings.get("stages")
    if not frames or whole is None or stages is None:
        return whole, None
    spent = StageTimes(**stages)
    again = StageTimes(**(refinement.get("stages") or {})) if refinement.get("frames") else StageTimes()
    return whole + again.whole / frames, (spent + again) * (1 / frames)


def own_masks(run: Mapping[str, Any]) -> int | None:
    """How many estimates have the solver's own mask instead of the unchanged initial mask; None if unknown.

    Args:
        run: ``run.json`` of a run that is over.
    """
    masks = run["counts"].get("masks") or {}
    if sum(masks.values()) < run["counts"]["frames"]:
        return None
    return sum(masks[source] for source in MaskSource if source.is_own)


def _plain(stages: StageTimes | None, together: StageTimes | None = None) -> dict[str, float] | None:
    return None if stages is None else asdict(stages + (together or StageTimes()))


def _by_status(records: Sequence[FrameRecord]) -> dict[str, int]:
    found = Counter(record.status for record in records)
    return {status.value: found[status] for status in Status}


def _mean_iou(records: Sequence[FrameRecord]) -> float | None:
    ious = [record.iou_initial for record in records if record.iou_initial is not None]
    return float(np.mean(ious)) if ious else None


def versions() -> dict[str, str | None]:
    """Versions of the packages that a result depends on."""
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


_SAME_START = 2.0  # seconds; Linux counts the start of a process from that of the machine, known to a second


def this_process() -> dict[str, Any]:
    """Number, machine and start (seconds since 1970) of this process, for ``run.json``."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "started": round(psutil.Process().create_time(), 2),
    }


def is_gone(process: Mapping[str, Any]) -> bool | None:
    """Whether a process that described itself by `this_process` has ended; None if that cannot be known.

    The system gives the number of an ended process to a later one: if the process of that number started at another
    time, it is another process.
    """
    pid, started = process.get("pid"), process.get("started")
    if not isinstance(pid, int) or pid <= 0 or process.get("host") != socket.gethostname():
        return None
    try:
        now = psutil.Process(pid).create_time()
    except psutil.NoSuchProcess:
        return True
    except psutil.AccessDenied:  # it is another user's, and exists
        return False
    return isinstance(started, int | float) and abs(now - started) > _SAME_START
