"""One job for the frame after the present one, done in another thread while the present one is worked on."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Generic, TypeVar

from tracking3d.frames import Image

T = TypeVar("T")


class Lookahead(Generic[T]):
    """The job for one announced image, if there is one.

    Nothing that the job reads may change before `result` or `discard`.
    """

    def __init__(self) -> None:
        self._job: tuple[Image, Future[T]] | None = None

    def begin(self, image: Image, job: Callable[[], T]) -> None:
        """Begin the job for ``image``."""
        self.discard()
        self._job = image, _thread().submit(job)

    def result(self, image: Image, job: Callable[[], T]) -> T:
        """What the job that was begun for this very image gives; if there is none, what ``job`` gives now.

        Raises:
            Exception: What the job ended with.
        """
        begun, self._job = self._job, None
        if begun is not None:
            result = begun[1].result()
            if begun[0] is image:
                return result
        return job()

    def discard(self) -> None:
        """Forget the job; if it has begun, wait until it has ended."""
        job, self._job = self._job, None
        if job is not None and not job[1].cancel():
            job[1].exception()


@functools.cache
def _thread() -> ThreadPoolExecutor:
    """The thread of all jobs."""
    return ThreadPoolExecutor(1, "tracking3d-lookahead")


# A thread does not survive a fork.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_thread.cache_clear)
