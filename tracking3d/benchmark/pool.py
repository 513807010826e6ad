"""Jobs in parallel processes: one that crashes costs itself only, and what is finished is not done again."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from typing import Any

from tracking3d.benchmark.job import LOG, Job
from tracking3d.errors import Tracking3dError

_LOOK = 0.1  # seconds between looks at a process


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        job: The job.
        scores: Its scores by name; None if it failed.
        error: Why it failed, in a sentence; empty if it did not.
        cached: Whether an earlier process had done it.
        seconds: Wall time.
    """

    job: Job
    scores: dict[str, Any] | None
    error: str = ""
    cached: bool = False
    seconds: float = 0.0


Listener = Callable[[Outcome], None]
"""Is told of every job as it is done."""


def run_jobs(
    jobs: Sequence[Job], processes: int = 1, listener: Listener = lambda outcome: None
) -> list[Outcome]:
    """Run all jobs, ``processes`` at a time; the outcomes are in the order of the jobs.

    Jobs that depend on the same things, as when two rows of a table are one setting, are done once. Ctrl-C stops
    the processes; what was finished is kept and found again by the next call.
    """
    stop = Event()
    turns: defaultdict[Path, Lock] = defaultdict(Lock)
    asking = Lock()

    def one(job: Job) -> Outcome:
        try:
            with asking:
                turn = turns[job.folder]
            with turn:  # the second of two equal jobs finds the first one's result
                outcome = _run(job, stop)
        except Tracking3dError as error:  # the sequence cannot be read
            outcome = Outcome(job, None, str(error))
        if not stop.is_set():  # what was stopped did not fail
            listener(outcome)
        return outcome

    with ThreadPoolExecutor(max(processes, 1)) as pool:
        try:
            return list(pool.map(one, jobs))
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


def _run(job: Job, stop: Event) -> Outcome:
    started = time.monotonic()
    if (scores := job.finished()) is not None:
        return Outcome(job, scores, cached=True)
    log = job.folder / LOG
    command = [sys.executable, "-m", "tracking3d.benchmark.job", str(job.write())]
    code = _call(command, log, stop, job.variant.environment)
    scores = job.written() if code == 0 else None
    error = "" if scores is not None else _reason(code, log)
    return Outcome(job, scores, error, seconds=time.monotonic() - started)


def _call(command: list[str], log: Path, stop: Event, variables: Mapping[str, str]) -> int:
    # Processes that share a machine must not each take all of its cores.
    environment = {"OMP_NUM_THREADS": "1", **os.environ, **variables}
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, env=environment)
        while process.poll() is None:
            if stop.wait(_LOOK):
                process.kill()
        return process.wait()


def _reason(code: int, log: Path) -> str:
    if code == 0:
        return "Settings, frames or code changed while it ran; run it again."
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    said = lines[-1].strip() if lines else "it said nothing"
    how = f"was ended by signal {-code}" if code < 0 else f"ended with code {code}"
    return said if code == 1 and len(lines) == 1 else f"The process {how}: {said}; see {log}."
