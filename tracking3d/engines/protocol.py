"""The protocol of engines: they call functions in workers, report progress, and survive the death of a worker."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

Reporter = Callable[[Any], None]
"""Called by a function in a worker to report its progress; the report is pickled."""


@dataclass(frozen=True)
class Needs:
    """What one task takes of a machine."""

    threads: int = 1  # processor cores, and the threads that libraries get in the worker
    memory: float = 0.0  # megabytes; 0 if it is not to be considered
    gpus: float = 0.0  # share of a GPU; for Ray, which hides GPUs from tasks that ask for none


ONE_CORE = Needs()


@dataclass(frozen=True)
class Task:
    """One call in a worker."""

    number: int  # unique within a batch
    # a function of a module, called as function(tell, *arguments); its result is pickled
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()  # pickled too
    # gets what is printed, by native code too, and the last words of a process that dies
    log: Path | None = None
    # variables that must be set before libraries are imported, such as those that choose kernels
    environment: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Fault:
    """Why a task came to nothing."""

    reason: str  # a sentence
    crashed: bool = False  # whether its process ended, not only the call


@dataclass(frozen=True)
class Began:
    """A task has begun."""

    number: int  # number of the task
    worker: str  # what the worker is called; a worker that is free has the name again
    attempt: int = 1  # 1, or more if it was tried before


@dataclass(frozen=True)
class ProgressReport:
    """A report of a running task."""

    number: int
    content: Any


@dataclass(frozen=True)
class Ended:
    """A task has ended."""

    number: int  # number of the task
    value: Any = None  # what the function returned; None if it came to nothing
    fault: Fault | None = None  # why it came to nothing; None if it did not
    attempts: int = 1  # how often it was begun
    again: bool = False  # whether it will be tried once more


Event = Began | ProgressReport | Ended


class Shared(Protocol):
    """A file that workers on other machines may read; it is sent to each of them once."""

    def read(self) -> bytes:
        """What it holds."""
        ...


class Engine(Protocol):
    """Calls functions in workers, several at a time. A worker that dies costs the task that it was at only."""

    name: str  # what it is called
    workers: int  # how many tasks it takes at a time

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
