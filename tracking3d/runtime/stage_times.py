"""How long a frame takes, stage by stage.

A stopwatch holds the times of one frame of one object. It is found through a context variable, so that what is deep
inside a solver can say which stage it is without being handed anything, and two trackings in two threads do not see
each other's.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import astuple, dataclass, fields, replace


@dataclass(frozen=True)
class StageTimes:
    """Seconds of wall time by stage."""

    decode: float = 0.0  # reading the frame; its share, if several objects are tracked
    track: float = 0.0  # the mask tracker, corrections included
    encode: float = 0.0  # the feature encoder
    solve: float = 0.0  # the pose, and whatever belongs to no other stage
    map: float = 0.0  # learning shape and texture from keyframes
    # masks of the run folder, and the picture of the frame before: that is drawn when its estimate is safe
    write: float = 0.0

    @property
    def whole(self) -> float:
        """All stages together."""
        return sum(astuple(self))

    def __add__(self, other: StageTimes) -> StageTimes:
        """Each stage's sum."""
        return StageTimes(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    def __mul__(self, factor: float) -> StageTimes:
        """Each stage times a number."""
        return StageTimes(*(factor * seconds for seconds in astuple(self)))


STAGES = tuple(field.name for field in fields(StageTimes))
"""Their names, in the order in which a frame goes through them."""


class Stopwatch:
    """Gives every moment to one stage: a stage within another one stops the outer one's time."""

    def __init__(self) -> None:
        self._stages: list[str] = []
        self._since = 0.0
        self.times = StageTimes()

    def begin(self, stage: str) -> None:
        """From here on time belongs to ``stage``."""
        self._account()
        self._stages.append(stage)

    def end(self) -> None:
        """From here on time belongs to the stage before."""
        self._account()
        self._stages.pop()

    def _account(self) -> None:
        now = time.perf_counter()
        if self._stages:
            stage = self._stages[-1]
            self.times = replace(self.times, **{stage: getattr(self.times, stage) + now - self._since})
        self._since = now


_running: ContextVar[Stopwatch | None] = ContextVar("tracking3d_stopwatch", default=None)


@contextmanager
def measure(stage: str) -> Iterator[Stopwatch]:
    """Time the body; its time counts for ``stage`` unless it says otherwise.

    Yields:
        The stopwatch, whose ``times`` are complete afterwards.
    """
    watch = Stopwatch()
    token = _running.set(watch)
    watch.begin(stage)
    try:
        yield watch
    finally:
        watch.end()
        _running.reset(token)


@contextmanager
def in_stage(stage: str) -> Iterator[None]:
    """What is done within belongs to ``stage``; without a stopwatch nothing is timed."""
    watch = _running.get()
    if watch is None:
        yield
        return
    watch.begin(stage)
    try:
        yield
    finally:
        watch.end()
