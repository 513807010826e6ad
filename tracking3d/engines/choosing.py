"""The choice of an engine from the user's options."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tracking3d.engines.processes import ProcessEngine
from tracking3d.engines.protocol import ONE_CORE, Began, Ended, Engine, Event, Needs, ProgressReport, Task
from tracking3d.engines.worker import call


@contextmanager
def open_engine(
    address: str | None = None, workers: int | None = None, needs: Needs = ONE_CORE
) -> Iterator[Engine]:
    """Ray if an address is given, else processes of this machine; running tasks are stopped at the end.

    Args:
        address: Address of a Ray cluster, see `tracking3d.engines.on_ray.open_ray`.
        workers: Tasks at a time; as many as there are cores for if None.
        needs: What each takes.

    Raises:
        InputError: If Ray is asked for and not installed, or no cluster responds there.
    """
    if address is None:
        yield ProcessEngine(workers, needs)
        return
    from tracking3d.engines.on_ray import open_ray

    with open_ray(address, workers, needs) as engine:
        yield engine


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
        value, fault = call(task, lambda content: reports.append(ProgressReport(task.number, content)))
        return [Began(task.number, "this process"), *reports, Ended(task.number, value, fault)]

    def share(self, file: Path) -> None:
        """See `Engine.share`; workers see the same files."""

    def stop(self) -> None:
        """See `Engine.stop`; nothing runs."""
