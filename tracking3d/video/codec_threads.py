"""How many threads FFmpeg may take: it asks no library's setting, and with a process a core it must take one."""

from __future__ import annotations

import os

VARIABLE = "OMP_NUM_THREADS"
"""Environment variable that says how many threads the libraries of a process take."""


def codec_threads() -> int:
    """What the environment variable allows; 0, with which FFmpeg takes a thread for every core, without it."""
    given = os.environ.get(VARIABLE, "")
    return int(given) if given.isdecimal() and int(given) > 0 else 0
