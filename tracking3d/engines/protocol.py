"""The protocol of engines: they call functions in workers, report progress, and survive the death of a worker."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

Tell = Callable[[Any], None]
"""Called by a function in a worker to report its progress; the report is pickled."""


@dataclass(frozen=True)
class Needs:
    """What one task takes of a machine.

    Attributes:
        threads: Processor cores, and the threads that libraries get in the worker.
        memory: Megabytes; 0 if it is not to be considered.
        gpus: Share of a GPU; for Ray, which hides GPUs from tasks that ask for none.
    """

    threads: int = 1
    memory: float = 0.0
    gpus: float = 0.0


ONE_CORE = Needs()


@dataclass(frozen=True)
class Task:
    """One call in a worker.

    Attributes:
        number: Unique within a batch.
        function: A function of a module, called as ``function(tell, *arguments)``; its result is pickled.
        arguments: Pickled too.
        log: Gets what is printed, by native code too, and the last words of a process that dies.
        environment: Variables that must be set before libraries are imported, such as those that choose kernels.
    """

    number: int
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    log: Path | None = None
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """Why a task came to nothing."""

    reason: str  # a sentence
    crashed: bool = False  # whether its process ended, not only the call


@dataclass(frozen=True)
class Began:
    """A task has begun.

    Attributes:
        number: Number of the task.
        worker: What the worker is called; a worker that is free has the name again.
        attempt: 1, or more if it was tried before.
    """

    number: int
    worker: str
    attempt: int = 1


@dataclass(frozen=True)
class Told:
    """A report of a running task."""

    number: int
    content: Any


@dataclass(frozen=True)
class Ended:
    """A task has ended.

    Attributes:
        number: Number of the task.
        value: What the function returned; None if it came to nothing.
        fault: Why it came to nothing; None if it did not.
        attempts: How often it was begun.
        again: Whether it will be tried once more.
    """

    number: int
    value: Any = None
    fault: Fault | None = None
    attempts: int = 1
    again: bool = False


Event = Began | Told | Ended


class Shared(Protocol):
    """A file that workers on other machines may read; it is sent to each of them once."""

    def read(self) -> bytes:
        """What it holds."""
        ...


class Engine(Protocol):
    """Calls functions in workers, several at a time. A worker that dies costs the task that it was at only.

    Attributes:
        name: What it is called.
        workers: How many tasks it takes at a time.
    """

    name: str
    workers: int

    def start(self, task: Task) -> None:
        """Begin a task; there are fewer than `workers` of them."""
        ...

    def wait(self, seconds: float) -> list[Event]:
        """What has happened, in order; returns at once if something has, else after so many seconds."""
        ...

    def share(self, file: Path) -> Shared | None:
        """Make a file known to workers, as an argument of tasks; None if they see this machine's files anyway."""
        ...

    def stop(self) -> None:
        """End every running task: ask each to save its finished frames, and kill it if it does not."""
        ...
