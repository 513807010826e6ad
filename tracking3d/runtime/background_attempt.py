"""Long work in another thread, which then catches up with the items that arrived meanwhile.

The first map of a live source takes seconds. Frames that arrive meanwhile are queued, and the thread then processes
every third of them, at most ten at a time, until it is two behind. The caller's thread goes on with the result.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

State = TypeVar("State")
Item = TypeVar("Item")
Result = TypeVar("Result")

_MAX_LEFT = 2  # items that are left to the caller's thread in the end
_STRIDE = 3  # every third of the queued items is processed
_MAX_BATCH = 10  # items that are processed at a time


@dataclass(frozen=True, eq=False)
class AttemptOutcome(Generic[State, Item, Result]):
    """What came of an attempt."""

    state: State  # the state after it
    results: list[Result]  # of the items that were processed, in order; empty if the attempt found nothing
    left: list[Item]  # the items that arrived since


class BackgroundAttempt(Generic[State, Item, Result]):
    """An attempt that runs in a thread of its own from the beginning.

    Args:
        attempt: The long work: gives a state, and the results so far; none if it finds nothing.
        catch_up: Processes some of the items that arrived since, always with the newest, from a state on.
    """

    def __init__(
        self,
        attempt: Callable[[], tuple[State, Sequence[Result]]],
        catch_up: Callable[[State, Sequence[Item]], tuple[State, list[Result]]],
    ) -> None:
        self._attempt, self._catch_up = attempt, catch_up
        self._arrived: list[Item] = []
        self._lock = threading.Lock()
        self._done: Future[tuple[State, list[Result]]] = Future()
        # No daemon: kernels that run while the interpreter ends abort the process.
        threading.Thread(target=self._work, name="tracking3d-background").start()

    def add(self, item: Item) -> None:
        """Queue one more item."""
        with self._lock:
            self._arrived.append(item)

    def is_done(self, wait: float | None = 0.0) -> bool:
        """Whether the outcome is there, after at most so many seconds; with None it is waited for."""
        wait_for([self._done], wait)
        return self._done.done()

    @property
    def has_failed(self) -> bool:
        """Whether the other thread has raised an error."""
        return self._done.done() and self._done.exception() is not None

    def outcome(self) -> AttemptOutcome[State, Item, Result]:
        """What came of it, when it is done; the same if it is asked again.

        Raises:
            Exception: What the other thread has raised.
        """
        state, results = self._done.result()
        with self._lock:
            return AttemptOutcome(state, results, list(self._arrived))

    def _work(self) -> None:
        try:
            self._done.set_result(self._run())
        except BaseException as error:  # raised where the outcome is asked for
            self._done.set_exception(error)

    def _run(self) -> tuple[State, list[Result]]:
        state, found = self._attempt()
        results = list(found)
        if not results:
            return state, []
        while some := self._take(more_than=_MAX_LEFT):
            count = min(-(-len(some) // _STRIDE), _MAX_BATCH)
            places = np.linspace(len(some) / count, len(some), count).round().astype(int) - 1
            state, more = self._catch_up(state, [some[place] for place in places])
            results = [*results, *more]
        return state, results

    def _take(self, more_than: int = 0) -> list[Item]:
        """The queued items, which are removed; none if they are not more than so many."""
        with self._lock:
            if len(self._arrived) <= more_than:
                return []
            taken, self._arrived = self._arrived, []
        return taken
