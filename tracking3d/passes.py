"""The passes over a video: every frame is estimated, again with the final model if that is asked for, and drawn.

for frame in frames:                # first pass: causal estimates
    for recording in active:
        recording.take(frame)       # -> TrackedObject.step -> Session.step -> Solver.step
refine everything, then:
for frame in frames:                # second pass: estimates with the final model
    recording.take_again(frame)
adjust poses and surface by all frames together, then:
for frame in frames:                # third pass: masks
    recording.put_right(frame)
for frame in frames:                # last pass: pictures
    recording.draw(frame)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress

import cv2

from tracking3d.frame_reading import read_again, read_with_next, with_share
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.object_recording import ObjectRecording
from tracking3d.rendering.backend import shared_among
from tracking3d.results.records import FrameRecord
from tracking3d.video.source import FrameSource

Listener = Callable[[FrameRecord | SkippedFrame], None]
"""Is called with every frame that is done or skipped, and with each once more in a final refinement."""


class ActiveRecordings:
    """The recordings of one tracking that have not failed; iterating gives them.

    Args:
        recordings: One for each object.
        listener: Is called with every frame of every object.

    Attributes:
        errors: What ended the others, in the order in which they failed.
    """

    def __init__(
        self, recordings: Sequence[ObjectRecording], listener: Listener = lambda frame: None
    ) -> None:
        self._active, self._listener = list(recordings), listener
        self.errors: list[Exception] = []

    def __len__(self) -> int:
        return len(self._active)

    def __iter__(self) -> Iterator[ObjectRecording]:
        """Give each active recording; after the last one, raise the first error if all have failed."""
        yield from tuple(self._active)
        if not self._active:
            raise self.errors[0]

    @contextmanager
    def guard(self, recording: ObjectRecording) -> Iterator[None]:
        """If something fails within, this recording ends and the others go on."""
        try:
            yield
        except Exception as error:
            self._active.remove(recording)
            with suppress(Exception):  # the first error is the one to tell
                self.tell(recording.written())
            recording.give_up(error)
            self.errors.append(error)

    def give_up(self, error: BaseException) -> None:
        """End all active recordings because of ``error``."""
        for recording in self._active:
            recording.give_up(error)

    def tell(self, done: FrameRecord | SkippedFrame | None) -> None:
        """Call the listener, if there is something to tell."""
        if done:
            self._listener(done)


def go_through(
    source: FrameSource,
    frames: Iterable[Frame | SkippedFrame],
    recordings: Sequence[ObjectRecording],
    listener: Listener,
    first_pass_only: bool = False,
) -> None:
    """Run all passes. A recording that fails is ended; the others go on.

    Args:
        source: Where the frames come from.
        frames: Its frames, begun already.
        recordings: One for each object.
        listener: Is called with every frame of every object.
        first_pass_only: Stop when every frame has its causal estimate.

    Raises:
        Tracking3dError: The first failure, at the end or as soon as no recording is left.
    """
    active = ActiveRecordings(recordings, listener)
    with ExitStack() as threads:
        # The listener hears of a live source's frames at once.
        for recording in recordings if source.repeatable else ():
            threads.enter_context(recording.writing_beside())
        try:
            _run_first_pass(source, frames, active)
            if first_pass_only:
                for recording in active:
                    with active.guard(recording):
                        recording.pause()
                return
            look_again(source, active)
        except BaseException as error:
            active.give_up(error)
            raise
    if active.errors:
        raise active.errors[0]


def _run_first_pass(
    source: FrameSource, frames: Iterable[Frame | SkippedFrame], active: ActiveRecordings
) -> None:
    """Estimate every frame as it comes."""
    objects = len(active)
    for frame, coming in read_with_next(source, frames) if any(one.takes for one in active) else ():
        shared = with_share(frame, objects) if isinstance(frame, Frame) else frame
        for recording in active:
            with active.guard(recording):
                active.tell(recording.take(shared, coming))
    _finish_writing(active)


def look_again(source: FrameSource, active: ActiveRecordings) -> None:
    """All frames have causal estimates: run the final refinement, if it is asked for and possible, and draw.

    Args:
        source: Where the frames come from.
        active: The recordings.
    """
    objects = len(active)
    with shared_among(1):
        for recording in active:
            with active.guard(recording):
                recording.begin_refinement(source)
        for frame in read_again(source) if any(one.looks_again for one in active) else ():
            for recording in active:
                with active.guard(recording):
                    active.tell(recording.take_again(with_share(frame, objects)))
        _finish_writing(active)
        with shared_among(cv2.getNumThreads()):
            for recording in active:
                with active.guard(recording):
                    recording.settle()
        for frame in read_again(source) if any(one.weighs_masks for one in active) else ():
            for recording in active:
                with active.guard(recording):
                    recording.put_right(frame)
        for frame in read_again(source) if any(one.draws for one in active) else ():
            for recording in active:
                with active.guard(recording):
                    recording.draw(frame)
        _finish_writing(active)
        for recording in active:
            with active.guard(recording):
                recording.finish()


def _finish_writing(active: ActiveRecordings) -> None:
    """Wait until everything is written that is written in other threads."""
    for recording in active:
        with active.guard(recording):
            active.tell(recording.written())
