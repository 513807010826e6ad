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
    return _try_lock(descriptor, shared) is not False


def is_locked(path: Path) -> bool | None:
    """Whether the lock on ``path`` is held; None on a file system without locks."""
    try:
        with path.open("rb") as file:
            free = _try_lock(file.fileno(), shared=True)
    except OSError:
        return False
    return None if free is None else not free


def _try_lock(descriptor: int, shared: bool) -> bool | None:
    """Whether the lock could be taken; None on a file system without locks."""
    try:
        _lock(descriptor, shared)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        return None
    return True
