"""How much memory this process holds, now and at most."""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path

_STATUS = Path("/proc/self/status")
_CLEAR_PEAK = Path("/proc/self/clear_refs")


def resident_memory() -> tuple[float, float] | None:
    """Megabytes of this process in memory: now, and at most since `forget_peak`; None where nobody tells.

    Where there is no ``/proc``, both are the most since the process began.
    """
    if _STATUS.exists():
        # Not getrusage: on Linux its maximum includes that of the process which started this one.
        lines = (line.split() for line in _STATUS.read_text(encoding="ascii").splitlines())
        kilobytes = {line[0]: int(line[1]) for line in lines if line and line[0] in ("VmRSS:", "VmHWM:")}
        if len(kilobytes) == 2:
            return 1.024e-3 * kilobytes["VmRSS:"], 1.024e-3 * kilobytes["VmHWM:"]
    try:
        import resource
    except ImportError:  # Windows
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # bytes on macOS, kilobytes elsewhere
    peak = 1e-6 * most * (1 if sys.platform == "darwin" else 1024)
    return peak, peak


def forget_peak() -> None:
    """Let the highest resident set size be that of now, where the system can do that (Linux)."""
    with contextlib.suppress(OSError):
        _CLEAR_PEAK.write_text("5", encoding="ascii")
