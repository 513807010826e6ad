"""A first map that is computed in another thread, while frames go on with their initial masks.

The first map takes seconds. A live source does not wait for it: frames that come meanwhile are kept, some of them are
estimated with the new map in the same thread until it has caught up with the newest, and then the solver goes on with
that map.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from concurrent.futures import wait as wait_for
from dataclasses import dataclass

import numpy as np

from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.estimation.online.state.object_map import Keyframe
from tracking3d.estimation.online.state.solver_state import SolverState

Pending = tuple[Keyframe, FrameEstimate]
"""A frame that waits for the first map, and its estimate so far."""

_FEW = 2  # frames that are left to the thread of the solver in the end
_ONE_IN, _MOST = 3, 10  # of the frames that came, one in so many is estimated, and so many at most at a time


@dataclass(frozen=True, eq=False)
class InitializationOutcome:
    """What came of an attempt.

    Attributes:
        state: The solver's state, with a map if there is one.
        estimates: Those of the frames that were estimated with it, in order; empty if the attempt failed.
        left: The frames that came since.
    """

    state: SolverState
    estimates: list[FrameEstimate]
    left: list[Pending]


class BackgroundInitialization:
    """An attempt to make the first map, in a thread of its own from the beginning.

    Args:
        initialize: Makes the map: gives the state, and the estimate of the last pending frame with those of the others
            in ``revised``; None if the frames do not determine a map yet.
        catch_up: Estimates frames that came since with the map: some of them, the newest included.
    """

    def __init__(
        self,
        initialize: Callable[[], tuple[SolverState, FrameEstimate | None]],
        catch_up: Callable[[SolverState, Sequence[Pending]], tuple[SolverState, list[FrameEstimate]]],
    ) -> None:
        self._initialize, self._catch_up = initialize, catch_up
        self._arrived: list[Pending] = []
        self._lock = threading.Lock()
        self._done: Future[tuple[SolverState, list[FrameEstimate]]] = Future()
        # No daemon: kernels that run while the interpreter ends abort the process.
        threading.Thread(target=self._work, name="tracking3d-initialization").start()

    def add(self, pending: Pending) -> None:
        """One more frame has come."""
        with self._lock:
            self._arrived.append(pending)

    def is_done(self, wait: float | None = 0.0) -> bool:
        """Whether the outcome is there, after at most so many seconds; with None it is waited for."""
        wait_for([self._done], wait)
        return self._done.done()

    def outcome(self) -> InitializationOutcome:
        """What came of it, when it is done.

        Raises:
            Exception: What the attempt has raised.
        """
        state, estimates = self._done.result()
        return InitializationOutcome(state, estimates, self._take())

    def _work(self) -> None:
        try:
            self._done.set_result(self._run())
        except BaseException as error:  # raised where the outcome is asked for
            self._done.set_exception(error)

    def _run(self) -> tuple[SolverState, list[FrameEstimate]]:
        state, estimate = self._initialize()
        if estimate is None:
            return state, []
        estimates = [*estimate.revised, estimate]
        while len(some := self._take(more_than=_FEW)):
            count = min(-(-len(some) // _ONE_IN), _MOST)
            places = np.linspace(len(some) / count, len(some), count).round().astype(int) - 1
            state, more = self._catch_up(state, [some[place] for place in places])
            estimates += more
        return state, estimates

    def _take(self, more_than: int = 0) -> list[Pending]:
        """The frames that have come; none if they are not more than so many."""
        with self._lock:
            if len(self._arrived) <= more_than:
                return []
            taken, self._arrived = self._arrived, []
        return taken
