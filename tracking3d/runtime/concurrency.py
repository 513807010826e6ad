"""Work in background threads: reading the next frames, writing the estimates, and what is done at intervals.

One thread reads a few frames ahead; every recording has one that writes, one estimate behind at most. Reading and
writing change no estimate, so that these are the same on every run, however busy the machine is. Frames that do not
depend on each other are done several at a time, their results in order. What goes wrong in such a thread is raised
where its result is asked for.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, TypeVar, cast

T = TypeVar("T")

READ_AHEAD = 3
"""Items that are read before they are asked for, at most."""
_END = object()


def read_ahead(items: Iterable[T], most: int = READ_AHEAD) -> Generator[T]:
    """The same items in the same order, taken from ``items`` in another thread.

    Closing it waits for the item in work; ``items`` itself is left to whoever opened it.

    Args:
        items: Nobody else takes from it meanwhile.
        most: How many are taken before they are asked for.
    """
    source = iter(items)
    with ThreadPoolExecutor(1, "tracking3d-reading") as thread:
        waiting = deque[Future[T | object]]()
        try:
            waiting.extend(thread.submit(next, source, _END) for _ in range(most))
            while (item := waiting.popleft().result()) is not _END:
                waiting.append(thread.submit(next, source, _END))
                yield cast(T, item)
        finally:
            thread.shutdown(wait=False, cancel_futures=True)


def with_next(items: Iterable[T]) -> Generator[tuple[T, T | None]]:
    """Every item with the one that follows it; None follows the last."""
    following = iter(items)
    item = next(following, _END)
    while item is not _END:
        after = next(following, _END)
        yield cast(T, item), None if after is _END else cast(T, after)
        item = after


def start_in_thread(job: Callable[[], T], threads: int) -> Callable[[], T]:
    """Begin a job in another thread, if more than one may be used.

    Args:
        job: Does not depend on what the caller does meanwhile.
        threads: How many threads there may be; with one the job is done at once.

    Returns:
        A function that waits for the result and returns it, or raises the job's error.
    """
    if threads <= 1:
        result = job()
        return lambda: result
    thread = ThreadPoolExecutor(1, "tracking3d-job")
    running = thread.submit(job)
    thread.shutdown(wait=False)
    return running.result


class OrderedExecutor:
    """Jobs that do not depend on each other, done several at a time; what they give comes in their order.

    Args:
        most: Jobs at a time; a single one runs in the caller's thread.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._threads: ThreadPoolExecutor | None = None
        self._waiting = deque[Future[Any]]()

    def do(self, job: Callable[[], T]) -> Iterator[T]:
        """Begin a job; gives what earlier ones gave, when as many wait as are done at a time.

        Raises:
            Exception: What an earlier one ended with.
        """
        if self._most <= 1:
            yield job()
            return
        if self._threads is None:
            self._threads = ThreadPoolExecutor(self._most, "tracking3d-in-turn")
        self._waiting.append(self._threads.submit(job))
        while len(self._waiting) > self._most:
            yield self._waiting.popleft().result()

    def rest(self) -> Iterator[Any]:
        """The results of the last jobs; the threads end."""
        while self._waiting:
            yield self._waiting.popleft().result()
        if self._threads is not None:
            self._threads.shutdown()
            self._threads = None


class BackgroundWriter:
    """Jobs that are done one after the other, each while the caller prepares the next; or in the caller's thread.

    Attributes:
        threaded: Whether jobs are done in another thread from here on.
    """

    def __init__(self) -> None:
        self.threaded = False
        self._thread: ThreadPoolExecutor | None = None
        self._running: Future[object] | None = None

    def do(self, job: Callable[[], T]) -> T | None:
        """Begin a job when the one before is done.

        Returns:
            The result of the job before, or of this one if there is no other thread; None if there is none yet.

        Raises:
            Exception: What the job before, or this one, ended with; the job is then not begun.
        """
        if not self.threaded:
            return job()
        before = self.wait()
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "tracking3d-writing")
        self._running = self._thread.submit(job)
        return cast("T | None", before)

    def wait(self) -> object:
        """Wait for the job in work; what it gave, or None if there is none.

        Raises:
            Exception: What it ended with.
        """
        running, self._running = self._running, None
        return None if running is None else running.result()

    def end(self) -> None:
        """Wait for the running job, even if it fails, and end the thread."""
        self.threaded = False
        with suppress(Exception):
            self.wait()
        if self._thread is not None:
            self._thread.shutdown()
            self._thread = None


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
