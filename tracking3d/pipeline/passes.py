"""The passes over a video: every frame is answered, looked at again where there is a final refinement, and drawn."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from typing import Any

import cv2

from tracking3d.frames import Frame, SkippedFrame
from tracking3d.pipeline.recorder import ObjectRecorder
from tracking3d.rendering.backend import share_threads
from tracking3d.results.records import FrameRecord
from tracking3d.runtime.concurrency import read_ahead, with_next
from tracking3d.video.source import FrameSource

Listener = Callable[[FrameRecord | SkippedFrame], None]
"""Is told of every frame as it is done, or skipped; where there is a final refinement, once more of each."""


def run_passes(
    source: FrameSource,
    frames: Iterable[Frame | SkippedFrame],
    recordings: list[ObjectRecorder],
    listener: Listener,
    first_pass_only: bool = False,
) -> None:
    """Take every recording through the frames, and through them again where it refines.

    A recording that fails is ended; the others go on.

    Args:
        source: Where the frames come from.
        frames: Its frames, begun already.
        recordings: One an object.
        listener: Is told of every frame of every object.
        first_pass_only: Stop when every frame has its causal answer.

    Raises:
        Tracking3dError: The first failure, at the end or as soon as no recording is left.
    """
    going_on, errors = list(recordings), list[Exception]()
    share = 1 / len(recordings)

    def each(action: Callable[[ObjectRecorder], FrameRecord | SkippedFrame | None]) -> None:
        for recording in tuple(going_on):
            try:
                if told := action(recording):
                    listener(told)
            except Exception as error:
                going_on.remove(recording)
                with suppress(Exception):  # the first error is the one to tell
                    if told := recording.written():
                        listener(told)
                recording.give_up(error)
                errors.append(error)
        if not going_on:
            raise errors[0]

    with ExitStack() as threads:
        # Of a live source, answers are told at once.
        for recording in recordings if source.repeatable else ():
            threads.enter_context(recording.writing_beside())
        try:
            for frame, coming in _with_upcoming(source, frames) if any(one.takes for one in going_on) else ():
                each(partial(ObjectRecorder.take, frame=_share_decoding(frame, share), coming=coming))
            each(ObjectRecorder.written)
            if first_pass_only:
                each(ObjectRecorder.pause)
                return
            run_refinement(source, going_on, each)
        except BaseException as error:
            for recording in going_on:
                recording.give_up(error)
            raise
    if errors:
        raise errors[0]


def run_refinement(
    source: FrameSource,
    recordings: Sequence[ObjectRecorder],
    each: Callable[[Callable[[ObjectRecorder], FrameRecord | SkippedFrame | None]], None],
) -> None:
    """All frames are answered: the final refinement where it is asked for and possible, the pictures, and the end.

    Args:
        source: Where the frames come from.
        recordings: One an object; some may be taken out on the way.
        each: Does something with every one of them.
    """
    share = 1 / len(recordings)
    with share_threads(1):
        each(partial(ObjectRecorder.begin_refinement, source=source))
        for frame in _read_again(source) if any(recording.looks_again for recording in recordings) else ():
            each(partial(ObjectRecorder.take_again, frame=_share_decoding(frame, share)))
        each(ObjectRecorder.written)
        with share_threads(cv2.getNumThreads()):
            each(ObjectRecorder.settle)
        for frame in _read_again(source) if any(recording.weighs_masks for recording in recordings) else ():
            each(partial(ObjectRecorder.put_right, frame=frame))
        for frame in _read_again(source) if any(recording.draws for recording in recordings) else ():
            each(partial(ObjectRecorder.draw, frame=frame))
        each(ObjectRecorder.written)
        each(ObjectRecorder.finish)


def _with_upcoming(
    source: FrameSource, frames: Iterable[Frame | SkippedFrame]
) -> Iterator[tuple[Frame | SkippedFrame, Frame | SkippedFrame | None]]:
    """The frames, each with the one that comes next, which is read meanwhile; that of a live source is not known."""
    if not source.repeatable:
        for frame in frames:
            yield frame, None
        return
    with closing(read_ahead(frames)) as ahead:
        yield from with_next(ahead)


def _read_again(source: FrameSource) -> Iterator[Frame]:
    """The frames that can be read, read once more."""
    with closing(time_frames(source)) as frames, closing(read_ahead(frames)) as ahead:
        for frame in ahead:
            if isinstance(frame, Frame):
                yield frame


def time_frames(source: FrameSource) -> Generator[Frame | SkippedFrame]:
    """The frames of a source with the time that reading them took; of a live one, which is waited for, without."""
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


def _share_decoding(frame: Frame | SkippedFrame, share: float) -> Any:
    return replace(frame, decoding=share * frame.decoding) if isinstance(frame, Frame) else frame
