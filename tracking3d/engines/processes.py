"""The engine of one machine: a process for every task, forked from one that has already imported everything.

A process that ends takes its memory, threads and open files along, whatever a thousand videos did in it; one that
crashes costs its own task.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psutil

from tracking3d.engines.protocol import ONE_CORE, Began, Ended, Event, Fault, Needs, ProgressReport, Task
from tracking3d.engines.worker import call, interruptible, last_words, threads_in_words

GRACE = 20.0
"""Seconds that a stopped task has to save its state."""

PRELOADED = [
    "tracking3d.pipeline.record",
    "tracking3d.ui.report.several",
    "tracking3d.rendering.kernels.compilation",
    "tracking3d.trackers.csrt",
    "tracking3d.trackers.flow",
    "tracking3d.trackers.precomputed",
    "tracking3d.features.rgb",
    "tracking3d.batch.one_video",
    "tracking3d.runtime.kernels_loaded",
]
"""Modules that take seconds to import or to load; they are loaded once, before the first task."""


@dataclass
class _Running:
    task: Task
    process: BaseProcess
    connection: Connection
    worker: int
    value: object = None
    fault: Fault | None = None
    has_ended: bool = False


class ProcessEngine:
    """Processes of this machine.

    Args:
        workers: Tasks at a time; as many as there are cores for them if None.
        needs: What each takes.

    Attributes:
        name: What it is called.
        workers: Tasks at a time.
    """

    name = "processes of this machine"

    def __init__(self, workers: int | None = None, needs: Needs = ONE_CORE) -> None:
        self.workers = workers or default_workers(needs)
        self._threads = needs.threads
        self._running: dict[int, _Running] = {}
        self._events: list[Event] = []

    def start(self, task: Task) -> None:
        """See `Engine.start`."""
        methods = multiprocessing.get_all_start_methods()
        # Variables that are read when a library is imported want a process that has imported nothing.
        forks = "forkserver" in methods and not task.environment
        if forks:
            multiprocessing.set_forkserver_preload(PRELOADED)
        context: Any = multiprocessing.get_context("forkserver" if forks else "spawn")
        ours, theirs = context.Pipe()
        variables = {**threads_in_words(self._threads), **task.environment}
        arguments = (theirs, task, self._threads, {**os.environ, **variables}, os.getcwd())  # noqa: PTH109
        process = context.Process(target=_work, args=arguments, daemon=False)
        with _environment(variables):
            process.start()
        theirs.close()
        worker = min(set(range(1, self.workers + 1)) - {one.worker for one in self._running.values()})
        self._running[task.number] = _Running(task, process, ours, worker)
        self._events.append(Began(task.number, f"worker {worker}"))

    def wait(self, seconds: float) -> list[Event]:
        """See `Engine.wait`."""
        handles = [one for running in self._running.values() for one in _handles(running)]
        ready = set(wait(handles, 0 if self._events else seconds)) if handles else set()
        if not handles and not self._events:
            time.sleep(seconds)
        for running in tuple(self._running.values()):
            if running.connection in ready or running.process.sentinel in ready:
                self._listen(running)
            if running.process.sentinel in ready:
                self._end(running)
        events, self._events = self._events, []
        return events

    def share(self, file: Path) -> None:
        """See `Engine.share`; workers see the same files."""

    def stop(self) -> None:
        """See `Engine.stop`."""
        for running in self._running.values():
            running.process.terminate()
        try:
            until = time.monotonic() + GRACE
            for running in self._running.values():
                running.process.join(max(0.0, until - time.monotonic()))
        finally:
            for running in self._running.values():
                running.process.kill()
                running.process.join()
                running.process.close()
                running.connection.close()
            self._running.clear()

    def _listen(self, running: _Running) -> None:
        """Take in what a worker has sent."""
        while not running.has_ended:
            try:
                if not running.connection.poll():
                    return
                kind, content = running.connection.recv()
            except (EOFError, OSError):
                return
            if kind == "report":
                self._events.append(ProgressReport(running.task.number, content))
            else:
                running.value, running.fault = content
                running.has_ended = True

    def _end(self, running: _Running) -> None:
        running.process.join()
        code = running.process.exitcode
        running.process.close()
        running.connection.close()
        del self._running[running.task.number]
        fault = running.fault
        if not running.has_ended:
            how = (
                f"was ended by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"
            )
            fault = Fault(f"The process {how}{last_words(running.task.log)}.", crashed=True)
        self._events.append(Ended(running.task.number, running.value, fault))


def default_workers(needs: Needs) -> int:
    """How many tasks the cores that this process may use, and the memory that is free, are enough for."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = max(1, cores // needs.threads)
    if needs.memory:
        free = 1e-6 * psutil.virtual_memory().available
        workers = max(1, min(workers, int(free // needs.memory)))
    return workers


def _handles(running: _Running) -> tuple[Any, ...]:
    """What to wait for: after its result, only the end of a process."""
    if running.has_ended:
        return (running.process.sentinel,)
    return running.process.sentinel, running.connection


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """The variables are set within; a process that is started then has them from its first moment."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(connection: Connection, task: Task, threads: int, environment: dict[str, str], folder: str) -> None:
    """What the process does: one task."""
    interruptible()
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    threading.Thread(target=_stop_when_alone, args=(connection,), daemon=True).start()
    try:
        outcome = call(task, lambda content: connection.send(("report", content)), threads)
    except KeyboardInterrupt:
        return
    connection.send(("ended", outcome))


def _stop_when_alone(connection: Connection) -> None:
    """If the process that hands out tasks is gone, the result is not collected: stop."""
    try:
        connection.recv()
    except (EOFError, OSError):
        os.kill(os.getpid(), signal.SIGTERM)
