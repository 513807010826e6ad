"""Which process writes a run, so that others see when it is gone."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from typing import Any

import psutil

_SAME_START = 2.0  # seconds; Linux counts the start of a process from that of the machine, known to a second


def this_process() -> dict[str, Any]:
    """Number, machine and start (seconds since 1970) of this process, for ``run.json``."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "started": round(psutil.Process().create_time(), 2),
    }


def is_gone(process: Mapping[str, Any]) -> bool | None:
    """Whether a process that described itself by `this_process` has ended; None if that cannot be known.

    The system gives the number of an ended process to a later one: if the process of that number started at another
    time, it is another process.
    """
    pid, started = process.get("pid"), process.get("started")
    if not isinstance(pid, int) or pid <= 0 or process.get("host") != socket.gethostname():
        return None
    try:
        now = psutil.Process(pid).create_time()
    except psutil.NoSuchProcess:
        return True
    except psutil.AccessDenied:  # it is another user's, and exists
        return False
    return isinstance(started, int | float) and abs(now - started) > _SAME_START
