"""Running a batch: complete runs are skipped, the other videos become tasks, and the tables grow."""

from __future__ import annotations

import logging
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any

from tracking3d.batch.folder import BatchProgress, Failure, write_progress, write_tables
from tracking3d.batch.one_video import LOGS, WORK, send_log
from tracking3d.batch.storage import base, join_path, local, read_many, write
from tracking3d.batch.summary import MARKER, read_marker
from tracking3d.batch.tasks import Tasks, is_finished_video
from tracking3d.batch.video_job import VideoJob, share_networks
from tracking3d.engines.mapping import PAUSE, map_tasks
from tracking3d.engines.protocol import Began, Ended, Engine, Event, ProgressReport, Task
from tracking3d.errors import OutputError
from tracking3d.results import layout
from tracking3d.results.files import try_lock, writing
from tracking3d.results.layout import refuse_root
from tracking3d.ui.report.rendering import render_page

_log = logging.getLogger(__name__)

PROGRESS_EVERY, TABLES_EVERY, PAGE_EVERY = 2.0, 5.0, 60.0
"""Minimum seconds between two writes of each file."""
_PATIENCE = 20.0  # a file that takes long to write is written less often: so many times as long lies between


@dataclass(frozen=True)
class BatchEvent:
    """Something that a scheduler or a person may want to know."""

    event: str  # began, progress, again, finished or failed of a video; batch of all
    video: str  # name of the run folder; empty for all
    about: Mapping[str, Any]  # what belongs to it
    progress: BatchProgress  # how far the batch is


Listener = Callable[[BatchEvent], None]


class Batch:
    """The state of a running batch.

    Args:
        out: Its folder.
        jobs: All videos.
        engine: The engine that runs them.
        report: Whether runs get reports.
        listener: Called with events.

    Attributes:
        progress: How far it is.
        failures: Videos that came to nothing, by name.
    """

    def __init__(
        self, out: str, jobs: Sequence[VideoJob], engine: Engine, report: bool, listener: Listener
    ) -> None:
        self._out, self._jobs, self._report, self._listener = out, jobs, report, listener
        self._tasks: Tasks | None = None
        self._shares: defaultdict[str, float] = defaultdict(float)  # finished share of each long video
        self._rows: dict[str, list[Mapping[str, Any]]] = {}
        self._pictures: dict[str, str] = {}
        self._workers: dict[int, str] = {}
        self._running: dict[str, dict[str, Any]] = {}
        self._due = {"progress": 0.0, "tables": 0.0, "page": time.monotonic() + PAGE_EVERY}
        self._clock = time.monotonic()
        self._refused = 0
        self.failures: dict[str, Failure] = {}
        self.progress = BatchProgress(
            "running", len(jobs), engine=engine.name, workers=engine.workers, began=time.time()
        )

    def find_finished(self, overwrite: bool) -> list[int]:
        """Read the results of an earlier command; returns the numbers of the remaining jobs."""
        places = [join_path(self._out, job.name, MARKER) for job in self._jobs]
        contents = {} if overwrite else read_many(places)
        left = []
        for number, (job, place) in enumerate(zip(self._jobs, places, strict=True)):
            marker = read_marker(contents.get(place))
            fault = job.fault or ("" if overwrite else self._why_taken(job, marker))
            if fault:
                self.failures[job.name] = Failure(job.name, job.video, fault, 0, False, "")
            elif marker is None:
                left.append(number)
            else:
                self._take(job, marker)
        self.progress = replace(self.progress, before=len(self._rows))
        self._refused = len(self.failures)
        self._count()
        for job in self._jobs:
            if failure := self.failures.get(job.name):
                self._say("failed", job, {"reason": failure.reason, "attempts": 0, "crashed": False})
        return left

    def tasks(self, left: Sequence[int], tasks: Tasks) -> list[Task]:
        """The first tasks of all remaining videos, large ones first."""
        self._tasks = tasks
        return [tasks.first(number) for number in sorted(left, key=lambda number: -self._jobs[number].size)]

    def report_outcome(self, event: Event) -> None:
        """Handle an event of the engine."""
        assert self._tasks is not None
        job = self._jobs[self._tasks.video(event.number)]
        if isinstance(event, Began):
            self._workers[event.number] = event.worker
            about: dict[str, Any] = {"frames": 0, "of": None, "attempt": event.attempt}
            if label := self._tasks.label(event.number):
                about["step"] = label
            self._running[event.worker] = {"video": job.name, "since": time.time(), **about}
            self._say("began", job, {"worker": event.worker, **about})
        elif isinstance(event, ProgressReport):
            worker = self._workers.get(event.number, "")
            if worker in self._running:
                self._running[worker].update(event.content)
                self._say("progress", job, {"worker": worker, **event.content})
        else:
            self._end(job, event)

    def write(self, state: str = "running", *, now: bool = False) -> None:
        """Write the files that are due; at the end (``now``) all.

        Raises:
            OutputError: At the end, if a file cannot be written; before, this is only logged.
        """
        self._count(state)
        steps: list[tuple[str, float, Callable[[], object]]] = [
            ("progress", PROGRESS_EVERY, lambda: write_progress(self._out, self.progress)),
            ("tables", TABLES_EVERY, self._write_tables),
            ("page", PAGE_EVERY, self._write_page),
        ]
        problem: OutputError | None = None
        for name, every, step in steps:
            started = time.monotonic()
            if not now and started < self._due[name]:
                continue
            try:
                step()
            except OutputError as error:
                problem = problem or error
                _log.warning("%s It will be retried.", error)
            took = time.monotonic() - started
            self._due[name] = time.monotonic() + max(every, _PATIENCE * took)
        if now and problem:
            raise problem

    def _write_tables(self) -> None:
        write_tables(self._out, *self._reported_so_far())

    def _write_page(self) -> None:
        rows, failures = self._reported_so_far()
        write_overview(self._out, self.progress, rows, self._pictures, failures, self._report)

    def _reported_so_far(self) -> tuple[list[Mapping[str, Any]], list[Failure]]:
        rows = [row for rows in self._rows.values() for row in rows]
        return rows, sorted(self.failures.values(), key=lambda one: one.run)

    def say_all(self) -> None:
        """Report the progress of the batch to the listener."""
        self._listener(BatchEvent("batch", "", {}, self.progress))

    def _why_taken(self, job: VideoJob, marker: Mapping[str, Any] | None) -> str:
        """Why a video's run folder cannot be had, in a sentence; empty if it can, or is there already."""
        place = join_path(self._out, job.name)
        if marker is not None:
            what = "" if marker["key"] == job.key else "a run with another video, prompt or settings"
        else:  # what is whole comes with its marker, but elsewhere, where a part of it may have been sent
            path = local(place)
            what = "files that were not written by a batch" if path is not None and path.exists() else ""
        return f"{place} holds {what}; give another --out, or --overwrite." if what else ""

    def _end(self, job: VideoJob, ended: Ended) -> None:
        last = self._running.pop(self._workers.pop(ended.number, ""), {})
        fault = ended.fault
        if fault is None and not is_finished_video(ended):  # a step of a long video
            self._shares[job.name] += last.get("share", 0.0)
            return
        self._shares.pop(job.name, None)
        if job.name in self.failures:  # another part of it came to nothing before
            return
        if fault is None:
            self._take(job, ended.value)
            self._count()
            self._say("finished", job, {"attempts": ended.attempts, "rows": self._rows[job.name]})
            return
        about = {"reason": fault.reason, "attempts": ended.attempts, "crashed": fault.crashed}
        if not ended.again:
            # A worker that could say why it failed has sent its log; what one that crashed has printed may be
            # here.
            elsewhere = local(self._out) is None and not fault.crashed
            has_log = send_log(self._out, job) or elsewhere
            log = f"{LOGS}/{job.name}.log" if has_log else ""
            self.failures[job.name] = Failure(
                job.name, job.video, fault.reason, ended.attempts, fault.crashed, log
            )
            self._count()
        self._say("again" if ended.again else "failed", job, about)

    def _take(self, job: VideoJob, marker: Mapping[str, Any]) -> None:
        self._rows[job.name] = marker["rows"]
        for row, picture in zip(marker["rows"], marker["thumbnails"], strict=True):
            self._pictures[row["run"]] = picture

    def _count(self, state: str = "running") -> None:
        finished, failed = len(self._rows), len(self.failures)
        done = finished + failed - self.progress.before - self._refused
        parts = (min(1.0, _share(one)) for one in self._running.values())
        share = done + sum(parts) + sum(min(1.0, one) for one in self._shares.values())
        left = self.progress.total - self.progress.before - self._refused
        spent = time.monotonic() - self._clock
        to_go = spent * (left - share) / share if share > 0 else None
        self.progress = replace(
            self.progress,
            state=state,
            finished=finished,
            failed=failed,
            running={worker: dict(one) for worker, one in self._running.items()}
            if state == "running"
            else {},
            seconds_to_go=to_go if state == "running" else None,
        )

    def _say(self, event: str, job: VideoJob, about: Mapping[str, Any]) -> None:
        self._listener(BatchEvent(event, job.name, about, self.progress))


def _share(running: Mapping[str, Any]) -> float:
    """The share of its video that a worker has done since it began."""
    if "step" in running or not running.get("of"):
        return float(running.get("share", 0.0))
    return float(running["frames"] / running["of"])


def run_batch(
    jobs: Sequence[VideoJob],
    out: str,
    engine: Engine,
    *,
    retries: int = 1,
    overwrite: bool = False,
    report: bool = True,
    command: str = "",
    listener: Listener = lambda happening: None,
    pause: float = PAUSE,
) -> BatchProgress:
    """Track all videos; how far it came.

    Videos that an earlier command has finished stay, and those it has begun are resumed from their last finished frame.
    The largest videos are begun first, so that none is left alone at the end.

    Args:
        jobs: The videos.
        out: The folder of the batch.
        engine: The engine that runs them.
        retries: How often a video that came to nothing is tried again.
        overwrite: Track all videos again, and replace their run folders.
        report: Write a report of each run.
        command: The command line, for the record.
        listener: Called with events.
        pause: Seconds before a video is tried again.

    Raises:
        OutputError: If the folder is in use by another batch, or cannot be written.
        KeyboardInterrupt: After Ctrl-C; finished frames are saved, and the same call resumes.
    """
    with _alone(out):
        batch = Batch(out, jobs, engine, report, listener)
        left = batch.find_finished(overwrite)
        batch.write(now=True)
        shared = share_networks(engine, jobs)
        tasks = Tasks(jobs, out, command, report, engine.workers, shared)
        first = batch.tasks(left, tasks)
        batch.say_all()
        try:
            map_tasks(
                engine,
                first,
                retries=retries,
                pause=pause,
                listener=batch.report_outcome,
                further=tasks.further,
                meanwhile=batch.write,
            )
        except BaseException:
            with suppress(OutputError):
                batch.write("interrupted", now=True)
            raise
        if (folder := local(out)) is not None:
            with suppress(OSError):  # stays if there is something to resume
                (folder / WORK).rmdir()
        batch.write("finished", now=True)
        batch.say_all()
        return batch.progress


@contextmanager
def _alone(out: str) -> Iterator[None]:
    """No other batch writes into the folder, as far as this machine can tell."""
    folder = local(out)
    if folder is None:
        yield
        return
    refuse_root(folder)
    with writing(folder):
        (folder / LOGS).mkdir(parents=True, exist_ok=True)
        lock = (folder / ".lock").open("ab")
    with lock:
        if not try_lock(lock.fileno()):
            raise OutputError(f"{out} is in use by another batch; wait for it or choose another --out.")
        yield


MOST_PICTURES = 2000
"""Maximum number of runs with a picture; of more, those with the lowest confidence get one."""


def write_overview(
    out: str,
    progress: BatchProgress,
    rows: Sequence[Mapping[str, Any]],
    pictures: Mapping[str, str],
    failures: Sequence[Failure],
    report: bool = True,
) -> None:
    """Write the page.

    Args:
        out: The folder of the batch.
        progress: How far it is.
        rows: Rows of the table of results.
        pictures: JPEG in base64 by run.
        failures: Videos that came to nothing.
        report: Whether the runs have reports.

    Raises:
        OutputError: If it cannot be written.
    """
    doubtful = sorted(rows, key=lambda row: 0.0 if row["confidence"] is None else row["confidence"])
    pictured = {row["run"] for row in doubtful[:MOST_PICTURES]}
    runs = [
        {
            **row,
            "picture": pictures.get(row["run"], "") if row["run"] in pictured else "",
            "link": f"{row['run']}/{layout.REPORT}" if report else "",
        }
        for row in sorted(rows, key=lambda row: row["run"])
    ]
    page = render_page(
        "batch.html",
        ("batch.js",),
        title=base(out) or "batch",
        progress=progress,
        runs=runs,
        failures=failures,
        frames=sum(row["frames"] for row in rows),
        seconds=sum(row["seconds"] for row in rows),
    )
    write(join_path(out, layout.INDEX), page)
