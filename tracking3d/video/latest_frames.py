"""The newest frame of a source that does not wait, for a consumer that may be slower than it.

A thread reads the source as fast as it gives frames and keeps the newest only. What was overwritten before it was
taken comes as a `SkippedFrame`, so that nothing is left out without a trace.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, replace
from numbers import Real

from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.video.source import FrameSource, Intrinsics, source_notes

DROPPED = "dropped to keep up"
"""The reason of a frame that was overwritten before it was taken."""

_PATIENCE = 2.0  # seconds that a consumer who stops waits for a source in the middle of a frame


@dataclass(frozen=True, eq=False)
class LatestFrames:
    """A source whose frames are dropped when they come faster than they are taken, all but the first one.

    The first frame always arrives, for it is the one that a box or mask is about. An error of the source is raised in
    the consumer, after the frame that was there. When the iterator is closed the thread ends.

    See `tracking3d.video.source.FrameSource` for the other attributes.

    Raises:
        InputError: If the rate is not positive.
    """

    # gives the frames; `tracking3d.video.open_source` makes one of any iterable of arrays
    source: FrameSource
    # Frames a second at which the source is played, as a camera would, for tests and measurements; a frame's
    # time is then when it came, in seconds since the first. None takes them as they come.
    rate: float | None = None

    def __post_init__(self) -> None:
        if self.rate is not None and not (isinstance(self.rate, Real) and 0 < self.rate < float("inf")):
            raise InputError(
                f"A source cannot be played at {self.rate!r:.60} frames per second; give a positive rate."
            )

    @property
    def name(self) -> str:
        """The source's."""
        return self.source.name

    @property
    def count(self) -> int | None:
        """The source's; frames that are dropped count."""
        return self.source.count

    @property
    def fps(self) -> float | None:
        """The rate at which it is played, or the source's."""
        return self.rate or self.source.fps

    @property
    def intrinsics(self) -> Intrinsics | None:
        """The source's."""
        return self.source.intrinsics

    @property
    def intrinsics_origin(self) -> str:
        """The source's."""
        return self.source.intrinsics_origin

    @property
    def notes(self) -> tuple[str, ...]:
        """The source's."""
        return source_notes(self.source)

    @property
    def live(self) -> bool:
        """Frames do not wait."""
        return True

    @property
    def repeatable(self) -> bool:
        """Never: other frames would be dropped."""
        return False

    def __iter__(self) -> Iterator[Frame | SkippedFrame]:
        """Start reading the source."""
        return newest(self.source, self.rate)


def newest(
    frames: Iterable[Frame | SkippedFrame], rate: float | None = None
) -> Iterator[Frame | SkippedFrame]:
    """The frames that are the newest whenever one is asked for; see `LatestFrames`."""
    slot = _Slot()
    reader = threading.Thread(
        target=_read_frames, args=(frames, rate, slot), name="latest frames", daemon=True
    )
    reader.start()
    try:
        while items := slot.take():
            yield from items
    finally:
        slot.stop()
        reader.join(_PATIENCE)


class _Slot:
    """Where the reader leaves the newest frame and the consumer finds it."""

    def __init__(self) -> None:
        self.stopped = threading.Event()
        self._changed = threading.Condition()
        self._frame: Frame | None = None
        self._first: Frame | None = None
        self._started = self._over = False
        self._skipped: list[SkippedFrame] = []
        self._error: BaseException | None = None

    def put(self, item: Frame | SkippedFrame) -> None:
        """Leave an item; a frame that was not taken yet is dropped for it, unless it is the first one."""
        with self._changed:
            if isinstance(item, SkippedFrame):
                self._skipped.append(item)
            elif not self._started:
                self._first, self._started = item, True
            else:
                if self._frame is not None:
                    self._skipped.append(SkippedFrame(self._frame.index, DROPPED))
                self._frame = item
            self._changed.notify()

    def end(self, error: BaseException | None) -> None:
        """There will be no more."""
        with self._changed:
            self._over, self._error = True, error
            self._changed.notify()

    def stop(self) -> None:
        """No more items will be taken."""
        self.stopped.set()

    def take(self) -> list[Frame | SkippedFrame]:
        """Wait for a frame; those skipped come with it, in order of the source. Empty at the end.

        Raises:
            BaseException: What ended the source, once all that it gave is taken.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._first or self._frame or self._over)
            skipped, self._skipped = self._skipped, []
            if self._first is not None:
                # What was skipped after it waits for the next frame, as if it had not come yet.
                first, self._first = self._first, None
                self._skipped = [item for item in skipped if item.index > first.index]
                return [*(item for item in skipped if item.index < first.index), first]
            found: list[Frame | SkippedFrame] = [*skipped]
            if self._frame is not None:
                frame, self._frame = self._frame, None
                found.append(frame)
            if not found and self._error is not None:
                error, self._error = self._error, None
                raise error
        return sorted(found, key=lambda item: item.index)


def _read_frames(frames: Iterable[Frame | SkippedFrame], rate: float | None, slot: _Slot) -> None:
    """The thread's loop: leave item after item until there is none or none is taken any more."""
    error: BaseException | None = None
    iterator: Iterator[Frame | SkippedFrame] = iter(())
    try:
        iterator = iter(frames)
        started = time.monotonic()
        for count, item in enumerate(iterator):
            if rate is not None:
                slot.stopped.wait(max(0.0, started + count / rate - time.monotonic()))
            if slot.stopped.is_set():
                break
            if rate is not None and isinstance(item, Frame):
                item = replace(item, time=time.monotonic() - started)
            slot.put(item)
    except BaseException as reason:
        error = reason
    finally:
        try:
            # Here, for a generator is closed by the thread that it runs in; it lets its camera go.
            if isinstance(iterator, Generator):
                iterator.close()
        except BaseException as reason:
            error = error or reason
        slot.end(error)
