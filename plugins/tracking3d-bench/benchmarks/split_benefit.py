"""Is a long video tracked faster in parts, and as well? A synthetic clip, played to and fro, whole and in parts."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from tracking3d.config.models import PipelineConfig, PluginChoice
from tracking3d.errors import InputError
from tracking3d.frames import Box
from tracking3d.pipeline.record import record
from tracking3d.pipeline.submaps.split_run import record_in_parts
from tracking3d.results import layout
from tracking3d.results.files import write_image, write_mask, writing
from tracking3d.results.run_reader import RunReader, is_finished
from tracking3d.testing.synthesis.convex_clips import SyntheticClip, SyntheticSpec, degrade_masks, synthesize
from tracking3d.trackers.prompts.prompt import PromptSet
from tracking3d.video import open_source
from tracking3d_bench.evaluation.metrics import aligned_rotation_errors

_TAKEN = "seconds.json"


@dataclass(frozen=True)
class SplitMeasurement:
    """One way of tracking the video.

    Attributes:
        seconds: Wall time.
        rotation_mean: Mean rotation error in degrees, refined estimates; causal ones are left out.
        rotation_median: The median.
        tracked: Share of the frames.
        stages: Seconds of the steps of a split run, by name; empty for a whole one.
        parts: How many.
        reason: Why parts were not merged; empty if they were.
    """

    seconds: float
    rotation_mean: float
    rotation_median: float
    tracked: float
    stages: dict[str, float]
    parts: int = 1
    reason: str = ""


def looped(count: int, there: int) -> NDArray[np.int64]:
    """Frames ``(N,)`` of a clip of ``there`` frames, played to and fro."""
    period = max(2 * there - 2, 1)
    place = np.arange(count) % period
    return np.where(place < there, place, period - place)


def write_looped(
    folder: Path, spec: SyntheticSpec, count: int
) -> tuple[Path, SyntheticClip, NDArray[np.int64]]:
    """The frames and masks of a long video in ``folder``, each image stored once.

    Raises:
        OutputError: If it cannot be written.
    """
    clip, order = synthesize(spec), looped(count, spec.frames)
    rough = degrade_masks(clip.masks, spec.seed)
    with writing(folder):
        for name in ("once", "frames", "masks"):
            (folder / name).mkdir(parents=True, exist_ok=True)
        for index in range(spec.frames):
            write_image(folder / "once" / f"{index:04d}.png", clip.images[index])
            write_mask(folder / "once" / f"{index:04d}_mask.png", rough[index])
        for position, index in enumerate(order):
            for kind, suffix in (("frames", ""), ("masks", "_mask")):
                place = folder / kind / f"{position:06d}.png"
                place.unlink(missing_ok=True)
                os.link(folder / "once" / f"{index:04d}{suffix}.png", place)
    return folder / "frames", clip, order


def measure_split(
    config: PipelineConfig,
    folder: Path,
    *,
    frames: int,
    length: int,
    workers: int = 2,
    masks: str = "truth",
    size: tuple[int, int] = (320, 240),
    told: Callable[[str], None] = lambda sentence: None,
) -> dict[str, SplitMeasurement]:
    """Track the video whole and in parts; a run that is finished in ``folder`` is not done again.

    Args:
        config: The pipeline; the true camera is given.
        folder: For video and runs.
        frames: Number of frames of the video.
        length: Frames of a part.
        workers: Parts at a time.
        masks: ``truth``, with noise on the outlines, or ``tracker``.
        size: Width and height.
        told: Called with the present step, in words.

    Raises:
        InputError: If ``masks`` is neither.
    """
    if masks not in ("truth", "tracker"):
        raise InputError(f"masks are truth or tracker, not {masks}.")
    spec = SyntheticSpec(frames=min(frames, 90), size=size, degrees_per_frame=2.0, fill=0.55)
    source, clip, order = write_looped(folder / "video", spec, frames)
    update: dict[str, Any] = {"camera": config.camera.model_copy(update={"fov": spec.fov})}
    box: Box | None = clip.box
    if masks == "truth":
        update["tracker"] = PluginChoice(name="precomputed", path=str(folder / "video" / "masks"))
        box = None
    config = config.model_copy(update=update)
    measured = {}
    for name in ("whole", "split"):
        out = folder / name
        if not is_finished(out):
            told(f"{name}: {frames} frames")
            began, reason, parts = time.monotonic(), "", 1
            if name == "whole":
                record(open_source(str(source)), config, out, box=box, overwrite=True)
            else:
                ended = record_in_parts(
                    source,
                    config,
                    out,
                    PromptSet.of_one(box),
                    length=f"{length}f",
                    workers=workers,
                    overwrite=True,
                )
                reason, parts = (ended.reason if len(ended.folders) > 1 else ""), ended.parts
            taken = {"seconds": time.monotonic() - began, "reason": reason, "parts": parts}
            (out / _TAKEN).write_text(json.dumps(taken), encoding="utf-8")
        measured[name] = _measured(out, clip.T_cam_obj[order])
    return measured


def _measured(folder: Path, T_true: NDArray[np.float64]) -> SplitMeasurement:
    taken = json.loads((folder / _TAKEN).read_text(encoding="utf-8"))
    if not (folder / layout.RUN).is_file():  # the parts were not merged
        return SplitMeasurement(taken["seconds"], np.nan, np.nan, np.nan, {}, taken["parts"], taken["reason"])
    run = RunReader(folder)
    R = np.stack([one.T_cam_obj[:3, :3] for one in run.frames])
    errors = aligned_rotation_errors(R, T_true[[one.index for one in run.frames], :3, :3])
    stages = (run.description.get("split") or {}).get("seconds", {})
    tracked = float(np.mean([one.status == "tracked" for one in run.frames]))
    return SplitMeasurement(
        taken["seconds"], float(errors.mean()), float(np.median(errors)), tracked, stages, taken["parts"]
    )


def format_split(measured: dict[str, SplitMeasurement]) -> Table:
    """Whole and in parts, side by side."""
    table = Table("", *measured)
    rows = {
        "parts": lambda one: str(one.parts),
        "seconds": lambda one: f"{one.seconds:.1f}",
        "of the whole": lambda one: f"{one.seconds / measured['whole'].seconds:.2f}",
        "rotation error, mean": lambda one: f"{one.rotation_mean:.2f}",
        "rotation error, median": lambda one: f"{one.rotation_median:.2f}",
        "tracked": lambda one: f"{one.tracked:.0%}",
    }
    for name, value in rows.items():
        table.add_row(name, *(value(one) for one in measured.values()))
    for stage in sorted({stage for one in measured.values() for stage in one.stages}):
        table.add_row(f"  {stage}", *(f"{one.stages.get(stage, 0):.1f}" for one in measured.values()))
    for one in measured.values():
        if one.reason:
            table.add_row("not merged", "", one.reason)
    return table
