"""One writer for a run folder: an advisory lock on an open file, which the system drops with the process."""

from __future__ import annotations

import os
import sys
from pathlib import Path

if sys.platform == "win32":
    import msvcrt

    # Locks are mandatory there, so one byte is locked far beyond what is ever read.
    _BYTE = 2**30

    def _lock(descriptor: int, shared: bool) -> None:
        os.lseek(descriptor, _BYTE, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
else:
    import fcntl

    def _lock(descriptor: int, shared: bool) -> None:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)


def try_lock(descriptor: int, shared: bool = False) -> bool:
    """Lock an open file until it is closed; False if another open file holds it.

    A file system without locks counts as free.
    """
    try:
        _lock(descriptor, shared)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return True
    return True


def is_locked(path: Path) -> bool:
    """Whether somebody holds the lock on ``path``."""
    try:
        with path.open("rb") as file:
            return not try_lock(file.fileno(), shared=True)
    except OSError:
        return False
