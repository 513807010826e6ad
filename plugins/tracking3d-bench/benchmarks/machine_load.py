"""Resource usage of a running batch: memory, open files, processes, shared memory and disk."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil

_SHARED_MEMORY = Path("/dev/shm")


@dataclass(frozen=True)
class Load:
    """What this process and those that it began took at one moment.

    Attributes:
        memory: Megabytes in memory, those that processes share counted in each.
        own_memory: Memory of this process in megabytes.
        descriptors: Open files of all of them.
        own_descriptors: Open files of this process.
        processes: How many there are.
        shared_memory: Megabytes of files in the system's folder for shared memory, of all programs.
        unfinished: Megabytes on disk of unfinished runs.
    """

    memory: float
    own_memory: float
    descriptors: int
    own_descriptors: int
    processes: int
    shared_memory: float
    unfinished: float = 0.0


@contextmanager
def measured_load(every: float = 1.0, unfinished: Path | None = None) -> Iterator[list[Load]]:
    """Measure repeatedly during the body; the list that is given grows.

    Args:
        every: Seconds between two samples.
        unfinished: Folder of unfinished runs, if its size is wanted.
    """
    samples: list[Load] = []
    over = threading.Event()

    def sample() -> None:
        while not over.wait(every):
            samples.append(load_now(unfinished))

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        over.set()
        thread.join()


def load_now(unfinished: Path | None = None) -> Load:
    """What this process and its descendants take at this moment."""
    own = psutil.Process()
    family = [own, *own.children(recursive=True)]
    memory = [_memory(process) for process in family]
    descriptors = [_descriptors(process) for process in family]
    return Load(
        sum(memory),
        memory[0],
        sum(descriptors),
        descriptors[0],
        len(family),
        _megabytes_in(_SHARED_MEMORY),
        _megabytes_in(unfinished) if unfinished is not None else 0.0,
    )


def _memory(process: psutil.Process) -> float:
    with suppress(psutil.Error):
        return 1e-6 * process.memory_info().rss
    return 0.0


def _descriptors(process: psutil.Process) -> int:
    with suppress(psutil.Error):
        return process.num_fds() if psutil.POSIX else process.num_handles()
    return 0


def _megabytes_in(folder: Path) -> float:
    total = 0.0
    with suppress(OSError):
        for file in folder.rglob("*"):
            with suppress(OSError):
                total += 1e-6 * 512 * file.stat().st_blocks
    return total
