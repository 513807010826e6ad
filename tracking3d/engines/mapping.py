"""The loop that hands tasks to an engine: as many at a time as it has workers, with retries of failed ones."""

from __future__ import annotations

import heapq
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from tracking3d.engines.protocol import Began, Ended, Engine, Event, Task

PAUSE = 2.0
"""Seconds before a failed task is retried; doubled each further time, because a disk or a network may have failed."""
LONGEST_PAUSE = 60.0
_LOOK = 0.5  # seconds, at most, between two looks at what is to be tried again

Listener = Callable[[Event], None]
"""Called with every event."""


def map_tasks(
    engine: Engine,
    tasks: Iterable[Task],
    *,
    retries: int = 0,
    pause: float = PAUSE,
    listener: Listener = lambda event: None,
    further: Callable[[Ended], Sequence[Task]] = lambda ended: (),
    meanwhile: Callable[[], None] = lambda: None,
) -> dict[int, Ended]:
    """Do all tasks, in their order as far as there are workers; how each ended, by its number.

    That a task comes to nothing is an `Ended` with a fault, not an error.

    Args:
        engine: The engine that runs them.
        tasks: What; their numbers differ.
        retries: How often a task that came to nothing is tried again.
        pause: See `PAUSE`.
        listener: Called with every event; an exception that it raises ends the loop.
        further: The tasks after a task that has ended for good, such as the next steps of the same video;
            it is begun before what has not begun yet.
        meanwhile: Is called again and again, at least twice a second, whether something happens or not.

    Raises:
        BaseException: What ended the loop, such as Ctrl-C; every task that ran is stopped first.
    """
    waiting, later = deque(tasks), list[tuple[float, int, Task]]()
    running, ended, attempts = dict[int, Task](), dict[int, Ended](), Counter[int]()
    try:
        while waiting or later or running:
            while later and later[0][0] <= time.monotonic():
                waiting.append(heapq.heappop(later)[2])
            while waiting and len(running) < engine.workers:
                task = waiting.popleft()
                running[task.number] = task
                attempts[task.number] += 1
                engine.start(task)
            meanwhile()
            for event in engine.wait(_LOOK):
                tried = attempts[event.number]
                if isinstance(event, Began):
                    listener(replace(event, attempt=tried))
                elif isinstance(event, Ended):
                    task = running.pop(event.number)
                    again = event.fault is not None and tried <= retries
                    event = replace(event, attempts=tried, again=again)
                    if again:
                        delay = min(pause * 2 ** (tried - 1), LONGEST_PAUSE)
                        heapq.heappush(later, (time.monotonic() + delay, task.number, task))
                    else:
                        ended[task.number] = event
                        waiting.extendleft(reversed(further(event)))
                    listener(event)
                else:
                    listener(event)
    except BaseException:
        engine.stop()
        raise
    return ended
