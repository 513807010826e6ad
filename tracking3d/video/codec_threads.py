"""The number of FFmpeg threads: it follows no library's setting, and must be one if there is a process per core."""

from __future__ import annotations

import os

VARIABLE = "OMP_NUM_THREADS"
"""Environment variable with the number of threads of libraries in a process."""


def codec_threads() -> int:
    """What the environment variable allows; 0, with which FFmpeg takes a thread for every core, without it."""
    given = os.environ.get(VARIABLE, "")
    return int(given) if given.isdecimal() and int(given) > 0 else 0
