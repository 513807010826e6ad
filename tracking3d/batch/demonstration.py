"""A batch of synthetic clips, with one worker and with more, and with everything gone wrong that can: what it takes.

`demonstrate` makes the clips, tracks them with each number of workers, once more with faults, and compares every
answer with that of a single run.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tracking3d.batch import fault_plugins
from tracking3d.batch.folder import read_failures
from tracking3d.batch.load import Load, measured_load
from tracking3d.batch.running import Happening, run_batch
from tracking3d.batch.video_job import VideoJob
from tracking3d.config.models import PipelineConfig
from tracking3d.engines.choosing import open_engine
from tracking3d.engines.protocol import Needs
from tracking3d.plugins import VARIABLE
from tracking3d.prompts import parse_box
from tracking3d.recording import record
from tracking3d.results.run_reader import RunReader
from tracking3d.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.video import VideoWriter, open_source

DISTINCT = 20
"""Clips that differ; of more videos every such clip is there several times."""
DAMAGED, ABORTING, FILLING = "damaged", "aborting", "filling"
_SETTLED = 0.25  # share of a batch after which nothing may grow any more

Said = Callable[[str], None]


@dataclass(frozen=True)
class Pass:
    """One way through all clips.

    Attributes:
        label: What it is called.
        workers: How many at a time.
        seconds: From the first video to the last.
        finished: Videos that are whole.
        failed: Why others are not, by name.
        frames_per_second: Of all workers together.
        different: How far poses are from those of the first pass at most, over videos that both have finished.
        again: Videos that were tried again.
        load: The most that it took of the machine.
        growth: How much more that was in the last quarter than after the first, by kind.
    """

    label: str
    workers: int
    seconds: float
    finished: int
    failed: dict[str, str]
    frames_per_second: float
    different: float
    again: tuple[str, ...]
    load: dict[str, float] = field(default_factory=dict)
    growth: dict[str, float] = field(default_factory=dict)


def demonstrate(
    config: PipelineConfig,
    folder: Path,
    videos: int = 200,
    frames: int = 20,
    workers: Sequence[int] = (1, 2),
    address: str | None = None,
    faults: bool = True,
    report: bool = True,
    said: Said = lambda text: None,
) -> list[Pass]:
    """Track clips with each number of workers, then with faults, then one by itself.

    Args:
        config: The pipeline.
        folder: Gets clips and results; passes that are there are replaced.
        videos: How many clips.
        frames: How many frames each has.
        workers: Numbers of workers.
        address: Of a Ray cluster; processes of this machine if None.
        faults: Whether to go through them once more, with the most workers and with faults.
        report: Whether runs get reports, as they do by default.
        said: Is told what goes on.

    Returns:
        A pass for each number of workers, with ``faults`` one more, and the single run of one clip at the end.
    """
    jobs = make_clips(folder / "clips", videos, frames, config)
    passes: list[Pass] = []
    for count in workers:
        said(f"{videos} videos, {count} at a time")
        passes.append(_pass(jobs, folder, f"workers_{count}", count, address, report))
    reference = folder / f"workers_{workers[0]}"
    if faults:
        said("once more, with faults")
        damaged = _with_faults(jobs, folder, address is None)
        passes.append(_pass(damaged, folder, "faults", max(workers), address, report, kill=jobs[0].name))
    said("one clip by itself")
    passes.append(_single(jobs[0], folder))
    return [replace(one, different=_difference(reference, folder / one.label, jobs)) for one in passes]


def make_clips(folder: Path, videos: int, frames: int, config: PipelineConfig) -> list[VideoJob]:
    """Make clips of solids that turn, unless they are there, and say where the object is in each."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = []
    for number in range(videos):
        name = f"clip_{number:04d}"
        file, box = folder / f"{name}.mp4", folder / f"{name}.box"
        like = folder / f"clip_{number % DISTINCT:04d}"
        if not box.is_file():
            if number < DISTINCT:
                box.write_text(_write_clip(file, frames, seed=number))
            else:
                shutil.copyfile(like.with_suffix(".mp4"), file)
                shutil.copyfile(like.with_suffix(".box"), box)
        jobs.append(VideoJob(name, str(file.absolute()), config, box=(box.read_text(),)))
    return jobs


def _write_clip(file: Path, frames: int, seed: int) -> str:
    clip = synthesize(SyntheticSpec(frames=frames, supersample=1, seed=seed))
    with VideoWriter(file, 10, clip.images[0].shape[:2]) as writer:
        for image in clip.images:
            writer.write(image)
    return ",".join(str(value) for value in cv2.boundingRect(clip.masks[0].astype(np.uint8)))


def _with_faults(jobs: Sequence[VideoJob], folder: Path, disk: bool) -> list[VideoJob]:
    """The same clips, and beside them one that is damaged, one whose plug-in aborts, and one that fills the disk."""
    trackers = {"Aborting": ABORTING, "Filling": FILLING}
    entries = [
        f"tracking3d.trackers:{name}={fault_plugins.__file__}:{kind}" for kind, name in trackers.items()
    ]
    os.environ[VARIABLE] = ";".join(entries)
    note = (folder / "disk_was_full").absolute()
    note.unlink(missing_ok=True)
    broken = folder / "clips" / f"{DAMAGED}.mp4"
    broken.write_bytes(Path(jobs[0].video).read_bytes()[:300])
    like = jobs[-1]

    def tracked_by(tracker: str) -> PipelineConfig:
        options = {"name": tracker, "note": str(note)}
        return PipelineConfig.model_validate({**like.config.model_dump(), "tracker": options})

    more = [
        replace(like, name=DAMAGED, video=str(broken.absolute())),
        replace(like, name=ABORTING, config=tracked_by(ABORTING)),
    ]
    if disk:  # a worker of Ray goes on to other videos, which would find it full too
        more.append(replace(like, name=FILLING, config=tracked_by(FILLING)))
    return [*jobs, *more]


def _pass(
    jobs: Sequence[VideoJob],
    folder: Path,
    label: str,
    workers: int,
    address: str | None,
    report: bool,
    kill: str = "",
) -> Pass:
    out = folder / label
    shutil.rmtree(out, ignore_errors=True)
    again: list[str] = []
    killed = False

    def listener(happening: Happening) -> None:
        nonlocal killed
        if happening.event == "again":
            again.append(happening.video)
        process = happening.about.get("process")
        if happening.video == kill and process and happening.about.get("frames") and not killed:
            killed = True
            with suppress(OSError):
                os.kill(process, signal.SIGKILL)

    with open_engine(address, workers, Needs()) as engine, measured_load() as samples:
        started = time.monotonic()
        progress = run_batch(
            jobs, str(out.absolute()), engine, report=report, listener=listener, retries=2, command=label
        )
        seconds = time.monotonic() - started
    failed = {one.run: one.reason for one in read_failures(str(out.absolute()))}
    frames = sum(len(RunReader(out / job.name).frames) for job in jobs if (out / job.name).is_dir())
    return Pass(
        label,
        workers,
        seconds,
        progress.finished,
        failed,
        frames / seconds,
        0.0,
        tuple(again),
        _most(samples),
        _growth(samples),
    )


def _single(job: VideoJob, folder: Path) -> Pass:
    """One clip without any batch, in this process."""
    out = folder / "single" / job.name
    shutil.rmtree(out, ignore_errors=True)
    started = time.monotonic()
    record(open_source(job.video), job.config, out, box=parse_box(job.box[0]))
    seconds = time.monotonic() - started
    return Pass("single", 1, seconds, 1, {}, len(RunReader(out).frames) / seconds, 0.0, ())


def _difference(reference: Path, other: Path, jobs: Sequence[VideoJob]) -> float:
    """The largest difference of any number in any pose, over the videos that both have finished."""
    most = 0.0
    for job in jobs:
        if (other / job.name).is_dir() and (reference / job.name).is_dir():
            ours, theirs = (
                np.stack([record.T_cam_obj for record in RunReader(place / job.name).frames])
                for place in (reference, other)
            )
            same = ours.shape == theirs.shape
            most = max(most, float(np.nanmax(np.abs(ours - theirs))) if same else np.inf)
    return most


def _most(samples: Sequence[Load]) -> dict[str, float]:
    return {name: max(getattr(one, name) for one in samples) for name in Load.__dataclass_fields__ if samples}


def _growth(samples: Sequence[Load]) -> dict[str, float]:
    """Of each kind, the mean of the last quarter less that of the second one."""
    quarter = int(_SETTLED * len(samples))
    if not quarter:
        return {}
    second, last = samples[quarter : 2 * quarter], samples[-quarter:]
    return {
        name: float(
            np.mean([getattr(one, name) for one in last]) - np.mean([getattr(one, name) for one in second])
        )
        for name in Load.__dataclass_fields__
    }


def to_json(passes: Sequence[Pass]) -> str:
    """The passes for a program."""
    return json.dumps([asdict(one) for one in passes], indent=1)


def speed_up(passes: Sequence[Pass]) -> float | None:
    """How many times as fast the most workers were as the first number of them; None of one pass."""
    plain: list[Any] = [one for one in passes if one.label.startswith("workers_")]
    return plain[0].seconds / plain[-1].seconds if len(plain) > 1 else None
