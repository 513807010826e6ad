"""Resource usage of a running batch: memory, open files, processes, shared memory and disk."""

from __future__ import annotations

import os
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

_PROCESSES = Path("/proc")
_SHARED_MEMORY = Path("/dev/shm")
_PAGE = os.sysconf("SC_PAGE_SIZE") if hasattr(os, "sysconf") else 4096


@dataclass(frozen=True)
class Load:
    """What this process and those that it began took at one moment.

    Attributes:
        memory: Megabytes in memory, those that processes share counted in each.
        own_memory: Of this process.
        descriptors: Open files of all of them.
        own_descriptors: Of this process.
        processes: How many there are.
        shared_memory: Megabytes of files in the system's folder for shared memory, of all programs.
        unfinished: Megabytes on disk of what is not whole yet.
    """

    memory: float
    own_memory: float
    descriptors: int
    own_descriptors: int
    processes: int
    shared_memory: float
    unfinished: float = 0.0


@contextmanager
def measure_load(every: float = 1.0, unfinished: Path | None = None) -> Iterator[list[Load]]:
    """Measure again and again while something goes on; the list grows, and stays empty if there is no ``/proc``.

    Args:
        every: Seconds between two samples.
        unfinished: Folder of what is not whole yet, if its size is wanted.
    """
    samples: list[Load] = []
    over = threading.Event()

    def sample() -> None:
        while not over.wait(every):
            if (load := load_now(unfinished)) is not None:
                samples.append(load)

    thread = threading.Thread(target=sample, daemon=True)
    thread.start()
    try:
        yield samples
    finally:
        over.set()
        thread.join()


def load_now(unfinished: Path | None = None) -> Load | None:
    """What this process and those that it began take; None if the system does not tell."""
    if not (_PROCESSES / "self/stat").is_file():
        return None
    own, family = os.getpid(), _family(os.getpid())
    memory = {number: _memory(number) for number in family}
    descriptors = {number: _descriptors(number) for number in family}
    return Load(
        sum(memory.values()),
        memory[own],
        sum(descriptors.values()),
        descriptors[own],
        len(family),
        _megabytes_in(_SHARED_MEMORY),
        _megabytes_in(unfinished) if unfinished is not None else 0.0,
    )


def _family(first: int) -> list[int]:
    """A process and all that it began, and those began in turn."""
    children: defaultdict[int, list[int]] = defaultdict(list)
    for folder in _PROCESSES.iterdir():
        if folder.name.isdecimal():
            with suppress(OSError, ValueError, IndexError):
                # The name of a program, in brackets, may hold anything.
                fields = (folder / "stat").read_text(errors="replace").rpartition(")")[2].split()
                children[int(fields[1])].append(int(folder.name))
    found = [first]
    for number in found:
        found += children[number]
    return found


def _memory(number: int) -> float:
    with suppress(OSError, ValueError, IndexError):
        return 1e-6 * _PAGE * int((_PROCESSES / str(number) / "statm").read_text().split()[1])
    return 0.0


def _descriptors(number: int) -> int:
    with suppress(OSError):
        return len(os.listdir(_PROCESSES / str(number) / "fd"))  # noqa: PTH208 (counted, not read)
    return 0


def _megabytes_in(folder: Path) -> float:
    total = 0.0
    with suppress(OSError):
        for file in folder.rglob("*"):
            with suppress(OSError):
                total += 1e-6 * 512 * file.stat().st_blocks
    return total
