"""The engine without workers: every task is called directly, for debugging."""

from __future__ import annotations

from pathlib import Path

from tracking3d.engines.protocol import Began, Ended, Event, Task, Told
from tracking3d.engines.worker import call


class InThisProcess:
    """One task at a time in this process; one that crashes takes everything along.

    Attributes:
        name: What it is called.
        workers: One.
    """

    name = "this process"
    workers = 1

    def __init__(self) -> None:
        self._task: Task | None = None

    def start(self, task: Task) -> None:
        """See `Engine.start`."""
        self._task = task

    def wait(self, seconds: float) -> list[Event]:
        """See `Engine.wait`; the task is done here."""
        task, self._task = self._task, None
        if task is None:
            return []
        reports: list[Event] = []
        value, fault = call(task, lambda content: reports.append(Told(task.number, content)))
        return [Began(task.number, "this process"), *reports, Ended(task.number, value, fault)]

    def share(self, file: Path) -> None:
        """See `Engine.share`; workers see the same files."""

    def stop(self) -> None:
        """See `Engine.stop`; nothing runs."""
