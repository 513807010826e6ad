"""How fast a clip is tracked, end to end: this version, the paper's preset and an earlier version, one after the other.

Each is a command of its own, ``tracking3d run``, in a process of its own; the figures are read from its run folder and
from what the system says of the process. So an earlier version is measured as this one is, whatever it is like inside.
"""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import tracking3d
from tracking3d.errors import InputError
from tracking3d.results import layout
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, read_records
from tracking3d.runtime.stage_times import STAGES, StageTimes
from tracking3d_bench.benchmark.version_metadata import write_metadata
from tracking3d_bench.datasets.truth import Truth

CHECKOUT = Path(tracking3d.__file__).parents[1]
"""The folder of this version's package."""

PERCENTILES = (50, 95, 100)
_POLL = 0.01  # seconds between looks at a file
_WARM_UP = 2  # frames of a run before the measured ones: it compiles kernels, and reads files once


@dataclass(frozen=True)
class Contender:
    """One way to track the clip."""

    name: str  # what it is called
    settings: tuple[str, ...] = ()  # words for tracking3d run
    frames: int | None = None  # how many of the clip's it tracks; None for all
    package: Path | None = None  # the folder that holds its package; None for this version


@dataclass(frozen=True)
class TrackSpeed:
    """What one run took."""

    name: str  # name of the contender
    frames: int  # frames with a causal estimate
    wall: float  # seconds of the whole command, start of the process and imports included
    processor: float | None  # seconds of all processors for it; None if the system does not say
    # seconds from the command to the first estimate: start of the process, imports, and that frame
    first_answer: float
    frames_per_second: float | None  # causal estimates a second of wall time, from the first to the last
    # seconds from when a frame is asked for to when its estimate is written: percentiles as `PERCENTILES`
    delays: tuple[float, ...]
    stages: StageTimes  # mean seconds a frame
    refinement: float | None  # seconds a frame of the final refinement; None if there is none
    peak_memory: float | None  # megabytes
    over_time: tuple[tuple[float, ...], ...]  # (N, stages) seconds of every frame, in the order of `STAGES`


def measure(
    truth: Truth,
    contenders: Sequence[Contender],
    folder: Path,
    repeats: int = 1,
    listener: Callable[[str], None] = lambda words: None,
) -> list[TrackSpeed]:
    """Track a clip from its box with all contenders in turn, as often as asked for; of each its run of median time.

    Args:
        truth: The clip.
        contenders: Who takes part.
        folder: For run folders.
        repeats: How often.
        listener: Called with the present step.

    Raises:
        InputError: If the clip has no box in its first frame, or a run fails; in its own words.
    """
    if truth.box is None:
        raise InputError(f"{truth.name} has no box in its first frame; a mask tracker cannot start.")
    taken: dict[str, list[TrackSpeed]] = {one.name: [] for one in contenders}
    for one in contenders:
        listener(f"warming up: {one.name}")
        _compile_ahead(one)
        _run(truth, one, folder / "warm", _WARM_UP)
    for number in range(repeats):
        for one in contenders:
            listener(f"{one.name}" + (f", {number + 1} of {repeats}" if repeats > 1 else ""))
            taken[one.name].append(_run(truth, one, folder / "run", one.frames))
    return [sorted(runs, key=lambda run: run.wall)[(len(runs) - 1) // 2] for runs in taken.values()]


def _run(truth: Truth, contender: Contender, folder: Path, frames: int | None) -> TrackSpeed:
    box = ",".join(f"{side:g}" for side in truth.box_in_frame() or ())
    some = ["--frames", f":{frames}"] if frames else []
    command = [
        "run", str(truth.frames[0].parent), "--box", box, "--out", str(folder), "--no-report", "--quiet", *some,
        *contender.settings,
    ]  # fmt: skip
    shutil.rmtree(folder, ignore_errors=True)  # another version would have to be able to read it
    before, started = _processor(), time.perf_counter()
    with _first_line_in(folder / layout.FRAMES) as first_line:
        done = _python(contender, "tracking3d", *command)
    wall, after = time.perf_counter() - started, _processor()
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["no error output"])[-1]
        raise InputError(f"{contender.name} cannot track {truth.name}: {said}")
    spent = None if before is None or after is None else after - before
    return _parse_speed(contender.name, folder, wall, spent, first_line[0] - started if first_line else wall)


@contextmanager
def _first_line_in(file: Path) -> Iterator[list[float]]:
    """Note when a file that another process writes is no longer empty: the one entry of the list, once it is."""
    found: list[float] = []
    over = threading.Event()

    def watch() -> None:
        while not over.wait(_POLL):
            with suppress(OSError):
                if file.stat().st_size:
                    found.append(time.perf_counter())
                    return

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield found
    finally:
        over.set()
        watcher.join()


def _compile_ahead(contender: Contender) -> None:
    """Compile its kernels, if its version can: a few frames do not use all of them."""
    package = contender.package or CHECKOUT
    room = (
        "runtime" if (package / "tracking3d/runtime/kernels_ahead.py").is_file() else "speed"
    )  # of earlier versions
    _python(contender, f"tracking3d.{room}.kernels_ahead")


def _python(contender: Contender, module: str, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a module of a contender's version."""
    package = contender.package or CHECKOUT
    # How many threads linear algebra has is for each version to say, not for this one's command line.
    environment = dict(os.environ)
    environment.pop("OPENBLAS_NUM_THREADS", None)
    # Without `-P` a package in the working directory would be taken, whatever version is asked for.
    command = [sys.executable, "-P", "-m", module, *words]
    with tempfile.TemporaryDirectory() as metadata:
        environment["PYTHONPATH"] = os.pathsep.join([write_metadata(package, Path(metadata)), str(package)])
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def _parse_speed(
    name: str, folder: Path, wall: float, processor: float | None, first_answer: float
) -> TrackSpeed:
    """The figures in a run folder."""
    reader = RunReader(folder)
    run = reader.description
    first: dict[int, FrameRecord] = {}
    for record in read_records(folder / layout.FRAMES):
        if not record.refined and not record.revision:
            first.setdefault(record.index, record)
    records = list(first.values())
    if not records:
        raise InputError(f"{name} has estimated no frame; see {folder}.")
    times = [record.stages or StageTimes(solve=record.seconds) for record in records]
    whole = [one.whole for one in times]
    refinement = run.get("refinement") or {}
    again = float(refinement.get("seconds") or 0.0) if refinement.get("state") == "finished" else 0.0
    timings = run["timings"]  # of earlier versions without passes
    causal = float(timings.get("passes", {}).get("tracking", timings["seconds_total"] - again))
    rest = causal - whole[0]
    return TrackSpeed(
        name=name,
        frames=len(records),
        wall=wall,
        processor=processor,
        first_answer=first_answer,
        frames_per_second=(len(records) - 1) / rest if len(records) > 1 and rest > 0 else None,
        delays=tuple(float(np.percentile(whole, share)) for share in PERCENTILES),
        stages=sum(times, StageTimes()) * (1 / len(times)),
        refinement=again / len(records) if again else None,
        peak_memory=run.get("peak_memory_mb"),
        over_time=tuple(tuple(getattr(one, stage) for stage in STAGES) for one in times),
    )


def check_out(tag: str, folder: Path) -> Path:
    """The package as it was at a tag, unpacked into ``folder``; the folder that holds it.

    Raises:
        InputError: If this package is not in a git checkout, or there is no such tag.
    """
    root = CHECKOUT
    command = ["git", "-C", str(root), "archive", "--format=tar", tag, "tracking3d", "pyproject.toml"]
    try:
        done = subprocess.run(command, capture_output=True, check=False)
    except OSError as error:
        raise InputError(
            f"--against {tag} needs git, which cannot be run: {error.strerror or error}."
        ) from error
    if done.returncode:
        said = (done.stderr.decode(errors="replace").strip().splitlines() or ["no output of git"])[-1]
        raise InputError(
            f"--against {tag} is no version that can be had from the git checkout {root}: {said}."
        )
    folder.mkdir(parents=True, exist_ok=True)
    with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return folder


def as_figures(speeds: Sequence[TrackSpeed]) -> list[dict[str, Any]]:
    """The same as plain values, for JSON; ``ratio`` is a frame's time over that of the first contender."""
    own = speeds[0].delays[0]
    return [
        {
            "name": one.name,
            "frames": one.frames,
            "wall": one.wall,
            "processor": one.processor,
            "first_answer": one.first_answer,
            "frames_per_second": one.frames_per_second,
            "delay": dict(zip((f"p{share}" for share in PERCENTILES), one.delays, strict=True)),
            "ratio": one.delays[0] / own if own else None,
            "stages": {stage: getattr(one.stages, stage) for stage in STAGES},
            "refinement_per_frame": one.refinement,
            "peak_memory_mb": one.peak_memory,
            "over_time": [dict(zip(STAGES, frame, strict=True)) for frame in one.over_time],
        }
        for one in speeds
    ]


def _processor() -> float | None:
    """Seconds of all processors that ended children of this process took; None on Windows."""
    if sys.platform == "win32":
        return None
    import resource

    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
