"""The stage that a command is in, and how far it is.

Code that takes long says so, however deep it is: ``report_progress("texture", 14, 24)``. Whoever wants to know listens:
the command line does, and so can users of the library::

    with listen_to_progress(print):
        track(frames, box=box).result()

The listener is found through a context variable, so that no signature has to hand it down. It is called in the thread
that listens: threads that are started within report nothing, and code that works in threads reports where it collects
what they did.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class StageProgress:
    """How far a stage is.

    Attributes:
        name: What is done, in the words that are shown: ``refining masks``.
        done: How many of its steps are done: frames, views, rounds.
        total: How many there are; None if that is not known, or the stage has one step only.
        inside: The stage of which this one is a part, and which goes on afterwards; empty if it is none.
    """

    name: str
    done: int = 0
    total: int | None = None
    inside: str = ""


ProgressListener = Callable[[StageProgress], None]
"""Is called when a stage begins and after each of its steps."""


@dataclass(eq=False)
class _Listening:
    """A listener, and the stages that are gone through step by step at the moment, the outermost first."""

    listener: ProgressListener
    stages: list[StageProgress] = field(default_factory=list)


_listening: ContextVar[_Listening | None] = ContextVar("tracking3d_progress", default=None)


@contextmanager
def listen_to_progress(listener: ProgressListener) -> Iterator[None]:
    """Within, ``listener`` is called with every stage and step; a listener outside hears nothing meanwhile.

    Args:
        listener: What it raises ends the work.
    """
    token = _listening.set(_Listening(listener))
    try:
        yield
    finally:
        _listening.reset(token)


def report_progress(name: str, done: int = 0, total: int | None = None) -> None:
    """Say which stage this is, and how many of its steps are done; see `StageProgress`."""
    if (listening := _listening.get()) is not None:
        inside = listening.stages[-1].name if listening.stages else ""
        listening.listener(StageProgress(name, done, total, inside))


def report_each(
    name: str,
    items: Iterable[T],
    total: int | None = None,
    counted: Callable[[T], bool] = lambda item: True,
) -> Generator[T]:
    """The same items; the stage begins with the first, and each is a step that is done when the next is asked for.

    What reports within a step is a part of the stage.

    Args:
        name: The stage.
        items: What the loop goes through.
        total: How many there are, if ``items`` has no length.
        counted: Whether an item is a step; one that takes next to no time is none.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    if (listening := _listening.get()) is None:
        yield from items
        return
    listener, stages = listening.listener, listening.stages
    stage = StageProgress(name, 0, total, stages[-1].name if stages else "")
    listener(stage)
    stages.append(stage)
    done = 0
    try:
        for item in items:
            yield item
            if counted(item):
                done += 1
                listener(replace(stage, done=done))
    finally:
        stages[:] = [one for one in stages if one is not stage]
