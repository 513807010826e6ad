"""The frames of a source from one in the middle: first forwards to the end, then backwards to the beginning."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from typing import Any

from tracking3d.errors import InputError, argument
from tracking3d.frames import Frame, SkippedFrame

START_FRAME = argument("start_frame=", "--start-frame ")
"""Name in messages of the start frame, before its number."""
_OPTION = argument("start_frame=", "--start-frame")
MOST_BYTES = 256 << 20
"""Memory in bytes for frames that are played backwards; a longer beginning is read more than once."""

Item = Frame | SkippedFrame


def check_start_frame(start: Any, repeatable: bool, name: str) -> None:
    """Make sure that a source can be gone through both ways from frame ``start``, as far as that can be seen now.

    Raises:
        InputError: If not.
    """
    if not isinstance(start, int) or isinstance(start, bool) or start < 0:
        raise InputError(f"{START_FRAME}{start!r:.40} is not a frame index; frames count from 0.")
    if not repeatable:
        raise InputError(
            f"{name} can be read only once and cannot be tracked backwards; leave out {_OPTION} and start "
            "with the frame in which the object is given."
        )


def both_ways(again: Callable[[], Iterable[Item]], start: int, name: str) -> Generator[Item]:
    """Frame ``start`` and those after it, then those before it, the last of them first.

    Args:
        again: Gives the frames from the beginning, whenever it is called.
        start: Index of the frame to begin with.
        name: What messages call the source.

    Raises:
        InputError: If that frame is not among them.
    """
    began = False
    with closing(_generator(again())) as frames:
        for item in frames:
            if item.index < start:
                continue
            if not began and item.index != start:
                break
            began = True
            yield item
    if not began:
        raise InputError(f"{START_FRAME}{start} is not among the selected frames of {name}.")
    yield from backwards(again, start)


def backwards(again: Callable[[], Iterable[Item]], before: int) -> Iterator[Item]:
    """The frames with an index below ``before``, from the last to the first."""
    while True:
        held: deque[Item] = deque()
        size, dropped = 0, False
        with closing(_generator(again())) as frames:
            for item in frames:
                if item.index >= before:
                    break
                held.append(item)
                size += _bytes(item)
                while size > MOST_BYTES and len(held) > 1:
                    size -= _bytes(held.popleft())
                    dropped = True
        if not held:
            return
        before = held[0].index
        while held:
            yield held.pop()
        if not dropped:
            return


def _bytes(item: Item) -> int:
    return item.image.nbytes if isinstance(item, Frame) else 0


def _generator(frames: Iterable[Item]) -> Generator[Item]:
    """The same as a generator, which can be closed."""
    yield from frames
