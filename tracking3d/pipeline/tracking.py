"""Tracking one object as a caller of the library has it: answers one after the other, and all of them in the end."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.models import PipelineConfig
from tracking3d.errors import InputError
from tracking3d.estimation.estimate import FrameEstimate
from tracking3d.frames import Frame, Prompt, SkippedFrame
from tracking3d.pipeline.passes import run_refinement
from tracking3d.pipeline.point_queries import PointFollowing
from tracking3d.pipeline.record import begin_recording, open_frames_in_order
from tracking3d.pipeline.recorder import ObjectRecorder
from tracking3d.pipeline.result import TemporaryRun, TrackingResult
from tracking3d.pipeline.session import Session
from tracking3d.pipeline.tracker_selection import choose_tracker
from tracking3d.prompts.corrections import Correction, check_corrections_fit, prompts_in
from tracking3d.prompts.prompt import damaged_start_error
from tracking3d.reconstruction.final_shape import make_final_shape
from tracking3d.video.source import FrameSource

_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class TrackRequest:
    """What `tracking3d.track` was asked for, checked.

    Attributes:
        source: The frames.
        config: The pipeline.
        prompt: Makes the object of the first frame; None where the mask tracker knows it.
        corrections: What the object is in later frames, by their index.
        start_frame: The frame in which the object is given; None for the first.
        skip_damaged: Whether frames before the first that can be read are passed over.
        queries: Points to follow, see `tracking3d.pipeline.point_queries.validate_queries`.
    """

    source: FrameSource
    config: PipelineConfig
    prompt: Callable[[Frame], Prompt] | None
    corrections: Mapping[int, Correction]
    start_frame: int | None
    skip_damaged: bool
    queries: NDArray[np.float64] | None


class Tracking(Iterator[FrameEstimate]):
    """An object on its way through a video: iterate over it for one answer a frame, or ask for the `result` of all.

    Nothing is computed before the first of both. ``for`` gives each answer as soon as it is there; ``async for`` does
    so while a thread of its own computes, so that the event loop goes on meanwhile.

    Where only the answers are taken, they are not kept, and memory depends on the object and not on the length of the
    video. Where ``refine=`` or ``model=`` was given, or `result` is what is asked for first, they are kept in a
    temporary run folder, which lives as long as the result.
    """

    def __init__(self, task: TrackRequest, keeps: bool) -> None:
        self._task, self._keeps = task, keeps
        self._answers: Generator[FrameEstimate] | None = None
        self._kept: TemporaryRun | None = None
        self._result: TrackingResult | None = None

    def __next__(self) -> FrameEstimate:
        """The answer for the next frame."""
        return next(self._begun(self._keeps))

    def result(self) -> TrackingResult:
        """All answers and the model: what the command line writes. Goes through the frames that are left.

        Raises:
            InputError: If answers were taken already and are not kept; if there is no frame.
            Tracking3dError: As in iterating.
        """
        if self._result is None:
            for _ in self._begun(True):
                pass
            if self._kept is None:
                raise InputError(
                    "The answers that were taken one by one are not kept; ask for result() first, or give refine= or "
                    "model= where both are wanted."
                )
            self._result = TrackingResult(self._kept, self._task.source, self._task.queries)
        return self._result

    async def result_async(self) -> TrackingResult:
        """The `result`, computed in a thread of its own.

        Where the task is cancelled, the frame in work is finished, and then the source is closed.
        """
        self._begun(True)
        async with _Worker(self) as worker:
            async for _ in worker.all():
                pass
            return await worker.of(self.result)

    def __aiter__(self) -> AsyncIterator[FrameEstimate]:
        """Answers from a thread; the next frame is taken when the next answer is asked for."""
        return self._in_thread()

    async def _in_thread(self) -> AsyncIterator[FrameEstimate]:
        async with _Worker(self) as worker:
            async for estimate in worker.all():
                yield estimate

    def close(self) -> None:
        """Stop, and let go of the source; what was kept until then stays."""
        if self._answers is None:
            self._answers = _no_frame_error()
        self._answers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _begun(self, keeps: bool) -> Generator[FrameEstimate]:
        if self._answers is None:
            if keeps:
                self._kept = TemporaryRun()
            self._answers = _estimates(self._task, self._kept)
        return self._answers


class _Worker:
    """A thread that goes through the answers of a tracking; leaving it waits for the frame in work, and closes."""

    def __init__(self, tracking: Tracking) -> None:
        self._tracking = tracking
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="tracking3d")

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *error: object) -> None:
        if any(error):
            await asyncio.shield(self.of(self._tracking.close))
        self._thread.shutdown()  # has nothing left to do

    def of(self, function: Callable[[], _T]) -> asyncio.Future[_T]:
        """What a function gives in the thread."""
        return asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def all(self) -> AsyncIterator[FrameEstimate]:
        """The answers that are left."""
        while (estimate := await self.of(lambda: next(self._tracking, None))) is not None:
            yield estimate


def _estimates(task: TrackRequest, kept: TemporaryRun | None) -> Generator[FrameEstimate]:
    """The answers, frame by frame; where there is a run they are kept in it, and after the last all is finished."""
    folder = None if kept is None else kept.folder
    session: Session | None = None
    recording: ObjectRecorder | None = None
    following = None if task.queries is None else PointFollowing(task.queries)
    skipped: list[SkippedFrame] = []
    with open_frames_in_order(task.source, task.config, task.start_frame) as frames, ExitStack() as writers:
        for frame in frames:
            if isinstance(frame, SkippedFrame):
                if session is None and not task.skip_damaged:
                    raise damaged_start_error(frame)
                skipped.append(frame)
                continue
            if session is None:
                session, recording = _start_session(task, frame, folder, writers)
            if recording is None:
                estimate = session.step(frame, *prompts_in(frame, task.corrections))
            else:
                for one in skipped:
                    recording.take(one)
                recording.take(frame)
                assert recording.latest is not None
                estimate = recording.latest
            skipped.clear()
            yield estimate if following is None else following.step(session, frame, estimate)
        if recording is not None:
            _finish(recording, task.source)
        elif folder is not None:
            raise InputError(f"{task.source.name} has no frame that can be decoded.")
    if kept is not None:
        kept.about_shape = make_final_shape(kept.folder, task.config, task.source)


def _start_session(
    task: TrackRequest, first: Frame, folder: Path | None, writers: ExitStack
) -> tuple[Session, ObjectRecorder | None]:
    source, prompt = task.source, task.prompt and task.prompt(first)
    config, choice = choose_tracker(task.config, source.count, not source.repeatable, first, prompt)
    session = Session(config, prompt, source.intrinsics, source.intrinsics_origin)
    check_corrections_fit(task.corrections.values(), first, config.tracker.name)
    if folder is None:
        return session, None
    recording = begin_recording(
        source, session, prompt, choice=choice or None, first=first, folder=folder, command=None, selection=None,
        overwrite=False, resume=False, writers=writers, start_frame=task.start_frame, corrections=task.corrections,
        resumable=False,
    )  # fmt: skip
    return session, recording


def _finish(recording: ObjectRecorder, source: FrameSource) -> None:
    """The final refinement, where the configuration asks for it and it is possible, and the model."""

    def does(action: Callable[[ObjectRecorder], Any]) -> None:
        action(recording)

    run_refinement(source, [recording], does)


def _no_frame_error() -> Generator[FrameEstimate]:
    yield from ()
