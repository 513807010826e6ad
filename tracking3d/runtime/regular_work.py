"""Work that is repeated every few seconds, at a bounded cost."""

from __future__ import annotations

import time
from collections.abc import Callable


class RegularWork:
    """A job that is done every few seconds while something else goes on; less often if it takes long.

    Args:
        job: What is done.
        every: Seconds between two times, and before the first.
        share: Share of the whole time that it may take.
    """

    def __init__(self, job: Callable[[], None], every: float, share: float) -> None:
        self._job, self._every, self._share = job, every, share
        self._due = time.monotonic() + every

    def do_if_due(self) -> None:
        """Do it now, if it is time."""
        started = time.monotonic()
        if started < self._due:
            return
        self._job()
        took = time.monotonic() - started
        self._due = started + max(self._every, took / self._share)
