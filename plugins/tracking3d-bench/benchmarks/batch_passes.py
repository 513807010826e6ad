"""Measures a batch of synthetic clips with one worker, with several, and with injected faults.

`demonstrate` makes the clips, tracks them with each number of workers, once more with faults, and compares every
estimate with that of a single run.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from rich.table import Table

import faulty_trackers
from machine_load import Load, measured_load
from tracking3d.batch.folder import read_failures
from tracking3d.batch.one_video import WORK
from tracking3d.batch.running import BatchEvent, run_batch
from tracking3d.batch.video_job import VideoJob
from tracking3d.config.models import PipelineConfig
from tracking3d.engines.choosing import open_engine
from tracking3d.engines.protocol import Needs
from tracking3d.pipeline.record import record
from tracking3d.plugins import VARIABLE
from tracking3d.results.run_reader import RunReader
from tracking3d.testing.synthesis.convex_clips import SyntheticSpec, synthesize
from tracking3d.trackers.prompts.prompt import parse_box
from tracking3d.video import VideoWriter, open_source

DISTINCT = 20
"""Clips that differ; of more videos every such clip is there several times."""
QUICK = ("object.frequency=4", f"camera.fov={SyntheticSpec().fov:g}")
"""Settings with which most of the time is not spent in the initialization of shape and focal length."""
SINGLE = 3
"""Clips that are tracked without a batch, too."""
DAMAGED, ABORTING, FILLING = "damaged", "aborting", "filling"
_SETTLED = 0.25  # share of a batch after which nothing may grow any more

Said = Callable[[str], None]


@dataclass(frozen=True)
class Asked:
    """What a demonstration is of.

    Attributes:
        videos: How many clips.
        frames: How many frames each has.
        size: Width and height of the frames.
        workers: Numbers of workers, a pass each.
        address: Address of a Ray cluster; processes of this machine if None.
        faults: How many of the clips to track again, with the most workers and with faults; none if 0.
        report: Whether runs get reports, as they do by default.
        minutes: After so long no further video is begun.
    """

    videos: int = 200
    frames: int = 10
    size: tuple[int, int] = (320, 240)
    workers: Sequence[int] = (1, 2)
    address: str | None = None
    faults: int = 60
    report: bool = True
    minutes: float = math.inf


@dataclass(frozen=True)
class Pass:
    """One way through all clips.

    Attributes:
        label: What it is called.
        workers: How many at a time.
        seconds: From the first video to the last.
        finished: Videos that are whole.
        failed: Why others are not, by name.
        frames_per_second: Frames a second of all workers together.
        different: Largest difference of poses from those of the first pass, over videos that both have finished.
        again: Videos that were tried again.
        load: The peak load of the machine.
        growth: How much more that was in the last quarter than after the first, by kind.
        stopped: Whether it was ended early.
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
    stopped: bool = False


def demonstrate(
    config: PipelineConfig, folder: Path, asked: Asked, said: Said = lambda text: None
) -> list[Pass]:
    """Track clips with each number of workers, then with faults, then some by themselves.

    After Ctrl-C, or when the time is over, the results so far are returned.

    Args:
        config: The pipeline.
        folder: Gets clips and results; passes that are there are replaced.
        asked: The clips and settings of the passes.
        said: Called with messages on progress and the result of each pass.

    Returns:
        A pass for each number of workers, with faults one more, and the single runs of some clips at the end.
    """
    until = time.monotonic() + 60 * asked.minutes
    said(f"{asked.videos} clips of {asked.frames} frames")
    jobs = make_clips(folder / "clips", asked.videos, asked.frames, config, asked.size)
    reference = folder / f"workers_{asked.workers[0]}"
    passes: list[Pass] = []

    def take(one: Pass) -> bool:
        passes.append(replace(one, different=_difference(reference, folder / one.label, jobs)))
        said(in_a_line(passes[-1]))
        return not one.stopped

    try:
        for count in asked.workers:
            pass_ = _Pass(folder, f"workers_{count}", count, asked, until, said)
            if not take(pass_.through(jobs)):
                return passes
        if asked.faults:
            some = jobs[: asked.faults]
            faulty = _with_faults(some, folder, asked.address is None)
            pass_ = _Pass(folder, "faults", max(asked.workers), asked, until, said)
            if not take(pass_.through(faulty, kill=some[len(some) // 2].name)):
                return passes
        take(_single(jobs[:SINGLE], folder))
    except KeyboardInterrupt:
        said("stopped")
    return passes


def make_clips(
    folder: Path, videos: int, frames: int, config: PipelineConfig, size: tuple[int, int] = (200, 160)
) -> list[VideoJob]:
    """Make clips of solids that turn, unless they are there, with the prompt of each."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = []
    for number in range(videos):
        name = f"clip_{number:04d}"
        file, box = folder / f"{name}.mp4", folder / f"{name}.box"
        like = folder / f"clip_{number % DISTINCT:04d}"
        if not box.is_file():
            if number < DISTINCT:
                spec = SyntheticSpec(frames=frames, size=size, supersample=1, seed=number)
                box.write_text(_write_clip(file, spec))
            else:
                shutil.copyfile(like.with_suffix(".mp4"), file)
                shutil.copyfile(like.with_suffix(".box"), box)
        jobs.append(VideoJob(name, str(file.absolute()), config, box=(box.read_text(),)))
    return jobs


def _write_clip(file: Path, spec: SyntheticSpec) -> str:
    clip = synthesize(spec)
    with VideoWriter(file, 10, clip.images[0].shape[:2]) as writer:
        for image in clip.images:
            writer.write(image)
    return ",".join(str(value) for value in cv2.boundingRect(clip.masks[0].astype(np.uint8)))


def _with_faults(jobs: Sequence[VideoJob], folder: Path, disk: bool) -> list[VideoJob]:
    """The same clips, plus one that is damaged, one whose plug-in aborts, and one that fills the disk."""
    trackers = {"Aborting": ABORTING, "Filling": FILLING}
    entries = [
        f"tracking3d.trackers:{name}={faulty_trackers.__file__}:{kind}" for kind, name in trackers.items()
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
    if disk:  # a worker of Ray continues with other videos, which would find it full too
        more.append(replace(like, name=FILLING, config=tracked_by(FILLING)))
    return [*jobs, *more]


@dataclass(frozen=True)
class _Pass:
    """A pass that is to be made."""

    folder: Path
    label: str
    workers: int
    asked: Asked
    until: float
    said: Said

    def through(self, jobs: Sequence[VideoJob], kill: str = "") -> Pass:
        """Go through the clips; the worker that is at ``kill`` is ended by a signal, once."""
        out = self.folder / self.label
        shutil.rmtree(out, ignore_errors=True)
        again: list[str] = []
        killed, stopped = False, False
        started, said = time.monotonic(), 0.0

        def listener(happening: BatchEvent) -> None:
            nonlocal killed, said
            about, progress = happening.about, happening.progress
            if happening.event == "again":
                again.append(happening.video)
            if happening.video == kill and about.get("process") and about.get("frames") and not killed:
                killed = True
                with suppress(OSError):
                    os.kill(about["process"], signal.SIGKILL)
            if happening.event == "finished" and progress.finished >= said + len(jobs) / 10:
                said = progress.finished
                seconds = time.monotonic() - started
                self.said(
                    f"{self.label}: {progress.finished} of {len(jobs)} videos in {seconds:.0f} s, "
                    f"{60 * progress.finished / seconds:.1f} a minute"
                )
            if time.monotonic() > self.until:
                raise KeyboardInterrupt

        unfinished = out / WORK
        with (
            open_engine(self.asked.address, self.workers, Needs()) as engine,
            measured_load(unfinished=unfinished) as samples,
        ):
            started = time.monotonic()
            try:
                run_batch(
                    jobs,
                    str(out.absolute()),
                    engine,
                    report=self.asked.report,
                    listener=listener,
                    retries=2,
                    command=self.label,
                )
            except KeyboardInterrupt:
                stopped = True
            seconds = time.monotonic() - started
        whole = [out / job.name for job in jobs if (out / job.name).is_dir()]
        frames = sum(len(RunReader(one).frames) for one in whole)
        failed = {one.run: one.reason for one in read_failures(str(out.absolute()))}
        return Pass(
            self.label,
            self.workers,
            seconds,
            len(whole),
            failed,
            frames / seconds,
            0.0,
            tuple(again),
            _most(samples),
            _growth(samples),
            stopped,
        )


def _single(jobs: Sequence[VideoJob], folder: Path) -> Pass:
    """Some clips without any batch, in this process."""
    shutil.rmtree(folder / "single", ignore_errors=True)
    started, frames = time.monotonic(), 0
    for job in jobs:
        out = folder / "single" / job.name
        record(open_source(job.video), job.config, out, box=parse_box(job.box[0]))
        frames += len(RunReader(out).frames)
    seconds = time.monotonic() - started
    return Pass("single", 1, seconds, len(jobs), {}, frames / seconds, 0.0, ())


def in_a_line(one: Pass) -> str:
    """What a pass came to."""
    told = [
        f"{one.label}: {one.finished} videos in {one.seconds:.0f} s{' (stopped early)' if one.stopped else ''}",
        f"{60 * one.finished / one.seconds:.1f} a minute",
        f"poses differ by {one.different:.1e} at most",
        f"{len(one.failed)} failed",
        f"{len(one.again)} tried again",
    ]
    return ", ".join(told)


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
    """For each kind, the mean of the last quarter less that of the second one."""
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
    """How many times as many videos a second the last number of workers finished as the first; None of one pass."""
    plain = [one for one in passes if one.label.startswith("workers_") and one.finished]
    if len(plain) < 2:
        return None
    return (plain[-1].finished / plain[-1].seconds) / (plain[0].finished / plain[0].seconds)


def format_passes(passes: Sequence[Pass]) -> Table:
    """A row for each pass."""
    table = Table("", "workers", "seconds", "videos", "frames/s", "difference", "tried again", "failed")
    for one in passes:
        table.add_row(
            one.label,
            str(one.workers),
            f"{one.seconds:.1f}",
            str(one.finished),
            f"{one.frames_per_second:.2f}",
            f"{one.different:.1e}",
            str(len(one.again)),
            str(len(one.failed)),
        )
    return table


def load_in_words(one: Pass) -> Iterator[str]:
    """Peak load of the machine in a pass, and its growth; nothing if that was not measured."""
    if most := one.load:
        yield (
            f"{one.label}: at most {most['memory']:.0f} MB in {most['processes']:.0f} processes "
            f"({most['own_memory']:.0f} MB in the first), {most['descriptors']:.0f} open files, "
            f"{most['shared_memory']:.1f} MB of shared memory, {most['unfinished']:.1f} MB of unfinished work"
        )
    if grown := one.growth:
        yield (
            f"{one.label}: from the second quarter to the last {grown['own_memory']:+.1f} MB and "
            f"{grown['own_descriptors']:+.1f} open files in the first process, {grown['memory']:+.1f} MB and "
            f"{grown['descriptors']:+.1f} open files in all, {grown['shared_memory']:+.1f} MB of shared memory, "
            f"{grown['unfinished']:+.1f} MB of unfinished work"
        )
