"""Jobs in workers: one that crashes costs itself only, and finished jobs are not repeated."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tracking3d.engines.choosing import open_engine
from tracking3d.engines.mapping import map_tasks
from tracking3d.engines.protocol import Began, Ended, Event, Reporter, Task
from tracking3d.errors import Tracking3dError
from tracking3d_bench.benchmark.job import LOG, Job, run_job


@dataclass(frozen=True)
class JobOutcome:
    """What became of a job."""

    job: Job  # the job
    scores: dict[str, Any] | None  # its scores by name; None if it failed
    error: str = ""  # why it failed, in a sentence; empty if it did not
    cached: bool = False  # whether an earlier process had done it
    seconds: float = 0.0  # wall time


Listener = Callable[[JobOutcome], None]
"""Called for every job when it is done."""


def run_jobs(
    jobs: Sequence[Job],
    processes: int = 1,
    listener: Listener = lambda outcome: None,
    address: str | None = None,
) -> list[JobOutcome]:
    """Run all jobs, ``processes`` at a time; the outcomes are in the order of the jobs.

    Jobs that depend on the same things, as when two rows of a table are one setting, are done once. Ctrl-C stops
    the workers; finished jobs are saved and found again by the next call.

    Args:
        jobs: What to run.
        processes: Workers.
        listener: Called for every outcome.
        address: Address of a Ray cluster that runs them, which must see the same files; this machine if None.
    """
    outcomes: dict[int, JobOutcome] = {}
    equal: dict[Path, list[int]] = {}
    began: dict[int, float] = {}

    def done(number: int, outcome: JobOutcome) -> None:
        outcomes[number] = outcome
        listener(outcome)

    for number, job in enumerate(jobs):
        try:
            others = equal.setdefault(job.folder, [])
            if not others and (scores := job.finished()) is not None:
                done(number, JobOutcome(job, scores, cached=True))
            others.append(number)
        except Tracking3dError as error:  # the sequence cannot be read
            done(number, JobOutcome(job, None, str(error)))
    same = {numbers[0]: numbers for numbers in equal.values()}

    def follow(first: int) -> None:
        """The second of two equal jobs has the first one's result."""
        result = outcomes[first]
        for number in same[first][1:]:
            done(
                number,
                JobOutcome(jobs[number], result.scores, result.error, cached=result.scores is not None),
            )

    def handle(event: Event) -> None:
        if isinstance(event, Began):
            began[event.number] = time.monotonic()
        elif isinstance(event, Ended):
            seconds = time.monotonic() - began.get(event.number, time.monotonic())
            done(event.number, _outcome(jobs[event.number], event, seconds))
            follow(event.number)

    for first in sorted(same.keys() & outcomes.keys()):
        follow(first)
    tasks = [
        Task(
            number,
            _run_written,
            (_absolute(job.write()),),
            _absolute(job.folder / LOG),
            job.variant.environment,
        )
        for number, job in ((number, jobs[number]) for number in same if number not in outcomes)
    ]
    if tasks:
        with open_engine(address, processes) as engine:
            map_tasks(engine, tasks, listener=handle)
    return [outcomes[number] for number in range(len(jobs))]


def _run_written(tell: Reporter, file: Path) -> None:
    """What a worker does: the job that was written for it."""
    run_job(Job.read(file))


def _outcome(job: Job, ended: Ended, seconds: float) -> JobOutcome:
    if ended.fault is not None:
        return JobOutcome(job, None, ended.fault.reason, seconds=seconds)
    scores = job.written()
    error = "" if scores is not None else "Its scores are not there; do all machines see the same files?"
    return JobOutcome(job, scores, error, seconds=seconds)


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))  # noqa: PTH100 (links stay as they are)
