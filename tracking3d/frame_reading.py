"""Reading the frames of a source: once in the order in which they are tracked, and again in order of time."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial

from tracking3d.frames import Frame, SkippedFrame
from tracking3d.side_by_side import read_ahead, with_next
from tracking3d.video.both_ways import both_ways
from tracking3d.video.source import FrameSource


def read_timed(source: FrameSource) -> Generator[Frame | SkippedFrame]:
    """Read the frames of a source, each with the time that reading took; without it if the source is live."""
    frames, started = iter(source), time.perf_counter()
    try:
        for frame in frames:
            if isinstance(frame, Frame) and source.repeatable:
                yield replace(frame, decoding=time.perf_counter() - started)
            else:
                yield frame
            started = time.perf_counter()
    finally:
        if isinstance(frames, Generator):
            frames.close()


def read_from(source: FrameSource, start_frame: int | None) -> Generator[Frame | SkippedFrame]:
    """Read the frames in the order in which they are tracked.

    Args:
        source: The source.
        start_frame: The prompt frame: it comes first, then those after it, then those before it, backwards. None
            gives all frames in order of time.

    Raises:
        InputError: If there is no such frame.
    """
    if start_frame is None:
        return read_timed(source)
    return both_ways(partial(read_timed, source), start_frame, source.name)


def read_with_next(
    source: FrameSource, frames: Iterable[Frame | SkippedFrame]
) -> Iterator[tuple[Frame | SkippedFrame, Frame | SkippedFrame | None]]:
    """Give each frame with the next one, which is read meanwhile; that of a live source is not known yet."""
    if not source.repeatable:
        for frame in frames:
            yield frame, None
        return
    with closing(read_ahead(frames)) as ahead:
        yield from with_next(ahead)


def read_again(source: FrameSource) -> Iterator[Frame]:
    """Read the frames once more, in order of time, without those that cannot be decoded."""
    with closing(read_timed(source)) as frames, closing(read_ahead(frames)) as ahead:
        for frame in ahead:
            if isinstance(frame, Frame):
                yield frame


def with_share(frame: Frame, objects: int) -> Frame:
    """The frame, with one object's share of the time that reading it took."""
    return replace(frame, decoding=frame.decoding / objects)
