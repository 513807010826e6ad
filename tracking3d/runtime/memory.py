"""How much memory this process holds, now and at most, and when garbage is collected."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

_STATUS = Path("/proc/self/status")


def resident_memory() -> tuple[float, float]:
    """Resident set size of this process in megabytes: now, and at most since it began."""
    now = psutil.Process().memory_info().rss
    return 1e-6 * now, 1e-6 * max(now, _peak())


def release_free_memory() -> None:
    """Give the system back what the C library keeps of what was freed; 25 ms where that is half a gigabyte (glibc)."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # C libraries other than glibc
        ctypes.CDLL(None).malloc_trim(0)


def _peak() -> int:
    """Highest resident set size in bytes, which psutil knows on Windows only."""
    if sys.platform == "win32":
        peak: int = psutil.Process().memory_info().peak_wset
        return peak
    with contextlib.suppress(OSError):
        # Not getrusage: on Linux its maximum includes that of the process which started this one.
        for line in _STATUS.read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS, kilobytes elsewhere
    return most * (1 if sys.platform == "darwin" else 1024)


@contextmanager
def collection_deferred() -> Iterator[None]:
    """Collect no garbage meanwhile, and never look again at the objects that are alive at the end.

    Importing torch and numba takes a fifth less time so, and each full collection after it has a few thousand
    objects to look at instead of some hundred thousand.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        if enabled:
            gc.enable()
