"""The passes over a video: every frame is estimated, again with the final model if that is asked for, and drawn.

In short::

    for frame in frames:                             # first pass: causal estimates
        for recording in active:
            recording.take(frame)                    # Session.step, Solver.step
    for recording in active:
        recording.begin_refinement(source)           # everything is refined
    for frame in frames:                             # second pass: estimates with the final model
        recording.take_again(frame)
    recording.refinement.adjust_all()                # poses, surface and lens by all frames together
    for frame in frames:                             # third pass: what masks have in common
        recording.refinement.collect_mask(frame)
    for frame in frames:                             # last pass: masks and images
        recording.refinement.draw(frame)
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress

from tracking3d.frames import Frame, SkippedFrame
from tracking3d.pipeline.final_refinement import FinalRefinement
from tracking3d.pipeline.frame_reading import read_again, read_with_next, with_share
from tracking3d.pipeline.recorder import ObjectRecorder
from tracking3d.rendering.backend import share_threads
from tracking3d.results.records import FrameRecord
from tracking3d.runtime.progress import report_each
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

    def __init__(self, recordings: Sequence[ObjectRecorder], listener: Listener = lambda frame: None) -> None:
        self._active, self._listener = list(recordings), listener
        self.errors: list[Exception] = []

    def __len__(self) -> int:
        return len(self._active)

    def __iter__(self) -> Iterator[ObjectRecorder]:
        """Give each active recording; after the last one, raise the first error if all have failed."""
        yield from tuple(self._active)
        if not self._active:
            raise self.errors[0]

    def refining(self) -> Iterator[tuple[ObjectRecorder, FinalRefinement]]:
        """Give each active recording that has a final refinement, with it; see `__iter__`."""
        for recording in self:
            if recording.refinement is not None:
                yield recording, recording.refinement

    @contextmanager
    def guard(self, recording: ObjectRecorder) -> Iterator[None]:
        """If the body raises, this recording ends and the others continue."""
        try:
            yield
        except Exception as error:
            self._active.remove(recording)
            with suppress(Exception):  # the first error is reported
                self.tell(recording.wait_until_written())
            recording.give_up(error)
            self.errors.append(error)

    def give_up(self, error: BaseException) -> None:
        """End all active recordings because of ``error``."""
        for recording in self._active:
            recording.give_up(error)

    def tell(self, done: FrameRecord | SkippedFrame | None) -> None:
        """Call the listener, if there is a new frame."""
        if done:
            self._listener(done)


@contextmanager
def running(
    source: FrameSource, recordings: Sequence[ObjectRecorder], listener: Listener
) -> Iterator[ActiveRecordings]:
    """The recordings that take the frames of a source; one that fails is ended, and the others continue.

    Raises:
        Tracking3dError: The first failure, at the end or as soon as no recording is left.
    """
    active = ActiveRecordings(recordings, listener)
    with ExitStack() as threads:
        # The listener hears of a live source's frames at once.
        for recording in recordings if source.repeatable else ():
            threads.enter_context(recording.writing_beside())
        try:
            yield active
        except BaseException as error:
            active.give_up(error)
            raise
    if active.errors:
        raise active.errors[0]


def first_pass(
    source: FrameSource, frames: Iterable[Frame | SkippedFrame], active: ActiveRecordings
) -> Generator[tuple[ObjectRecorder, Frame | SkippedFrame, Frame | SkippedFrame | None]]:
    """Each frame, for each recording, with the frame after it; none if no recording needs them.

    When it ends, what the recordings write in other threads is written.
    """
    objects = len(active)
    waits = any(one.needs_first_pass for one in active)
    with closing(report_each("tracking", read_with_next(source, frames), source.count)) as arriving:
        for frame, coming in arriving if waits else ():
            shared = with_share(frame, objects) if isinstance(frame, Frame) else frame
            for recording in active:
                yield recording, shared, coming
    _finish_writing(active)


def run_refinement(source: FrameSource, active: ActiveRecordings) -> None:
    """All frames have causal estimates: run the final refinement, if it is asked for and possible, and draw.

    Args:
        source: The source of the frames.
        active: The recordings.
    """
    objects = len(active)
    with share_threads(1):
        for recording in active:
            with active.guard(recording):
                recording.begin_refinement(source)
        with closing(_read_again("refining frames", source, active)) as again:
            for frame in again if any(one.needs_second_pass for one in active) else ():
                for recording in active:
                    with active.guard(recording):
                        active.tell(recording.take_again(with_share(frame, objects)))
        _finish_writing(active)
        _run_last_passes(source, active)
        for recording in active:
            with active.guard(recording):
                recording.finish(source)


def _run_last_passes(source: FrameSource, active: ActiveRecordings) -> None:
    """Adjust poses, surface and lens by all frames together, then masks; and draw."""
    for recording, refinement in active.refining():
        with active.guard(recording):
            refinement.adjust_all()
    decides_masks = any(each.decides_masks for _, each in active.refining())
    with closing(_read_again("collecting masks", source, active)) as again:
        for frame in again if decides_masks else ():
            for recording, refinement in active.refining():
                with active.guard(recording):
                    refinement.collect_mask(frame)
    for recording, refinement in active.refining():
        with active.guard(recording):
            refinement.settle_masks()
    with closing(_read_again("refining masks" if decides_masks else "drawing", source, active)) as again:
        for frame in again if any(active.refining()) else ():
            for recording, refinement in active.refining():
                with active.guard(recording):
                    refinement.draw(frame)
    _finish_writing(active)


def _read_again(stage: str, source: FrameSource, active: ActiveRecordings) -> Generator[Frame]:
    """The frames once more; those of which an estimate is made again are the steps of a stage."""
    made = [refinement.frames_again for _, refinement in active.refining()]
    if not made:
        return report_each(stage, read_again(source), source.count)
    frames = frozenset[int]().union(*made)
    return report_each(stage, read_again(source), len(frames), lambda frame: frame.index in frames)


def _finish_writing(active: ActiveRecordings) -> None:
    """Wait until everything is written that is written in other threads."""
    for recording in active:
        with active.guard(recording):
            active.tell(recording.wait_until_written())
