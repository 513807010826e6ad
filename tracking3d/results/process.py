"""The identity of the process that writes a run, so that others can see whether it still exists."""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_BOOT = Path("/proc/sys/kernel/random/boot_id")


def this_process() -> dict[str, Any]:
    """Number, machine and start of this process, for ``run.json``."""
    return {"pid": os.getpid(), "host": socket.gethostname(), "started": _start_time(os.getpid())}


def is_gone(process: Mapping[str, Any]) -> bool | None:
    """Whether the process described by `this_process` has ended; None if it cannot be known.

    A number is reused when its process has ended: one that started at another time is another process.
    """
    pid, started = process.get("pid"), process.get("started")
    if not isinstance(pid, int) or pid <= 0 or process.get("host") != socket.gethostname():
        return None
    if sys.platform == "win32":  # asking there would end it
        return None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except OSError:  # of another user, but there
        pass
    now = _start_time(pid)
    return now != started if now and started else False


def _start_time(pid: int) -> str | None:
    """When a process began: the machine's start and the clock ticks since then; None if unknown."""
    try:
        # The name in parentheses may hold spaces and parentheses itself.
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2]
        return f"{_BOOT.read_text(encoding='ascii').strip()} {fields.split()[19]}"
    except (OSError, IndexError):
        return None
