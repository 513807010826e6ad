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
from dataclasses import dataclass
from typing import TypeVar

T = TypeVar("T")


@dataclass(frozen=True)
class StageProgress:
    """How far a stage is.

    Attributes:
        name: What is done, in the words that are shown: ``refining masks``.
        done: How many of its steps are done: frames, views, rounds.
        total: How many there are; None if that is not known, or the stage has one step only.
    """

    name: str
    done: int = 0
    total: int | None = None


ProgressListener = Callable[[StageProgress], None]
"""Is called when a stage begins and after each of its steps."""

_listener: ContextVar[ProgressListener | None] = ContextVar("tracking3d_progress", default=None)


@contextmanager
def listen_to_progress(listener: ProgressListener) -> Iterator[None]:
    """Within, ``listener`` is called with every stage and step; a listener outside hears nothing meanwhile.

    Args:
        listener: What it raises ends the work.
    """
    token = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(token)


def report_progress(name: str, done: int = 0, total: int | None = None) -> None:
    """Say which stage this is, and how many of its steps are done; see `StageProgress`."""
    listener = _listener.get()
    if listener is not None:
        listener(StageProgress(name, done, total))


def report_each(name: str, items: Iterable[T], total: int | None = None) -> Generator[T]:
    """The same items; the stage begins with the first, and each is a step that is done when the next is asked for.

    Args:
        name: The stage.
        items: What the loop goes through.
        total: How many there are, if ``items`` has no length.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    report_progress(name, 0, total)
    for done, item in enumerate(items, start=1):
        yield item
        report_progress(name, done, total)
