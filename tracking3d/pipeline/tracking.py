"""Tracking one object from the library: estimates one after the other, and all of them at the end."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from types import TracebackType
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError, PluginError
from tracking3d.estimation.estimate import FrameEstimate, lost_estimate
from tracking3d.frames import Frame, MaskEstimate
from tracking3d.pipeline.frame_reading import with_share
from tracking3d.pipeline.open_tracking import NoFrameError, TrackedObject, TrackRequest, open_tracking
from tracking3d.pipeline.passes import ActiveRecordings, run_refinement
from tracking3d.pipeline.point_queries import PointFollowing
from tracking3d.pipeline.record import RecordOptions, begin_recording
from tracking3d.pipeline.result import TemporaryRun, TrackingResult
from tracking3d.reconstruction.final_shape import make_final_shape
from tracking3d.results.run_unit import apply_object_size
from tracking3d.trackers.prompts.corrections import UnmetCorrections, prompts_in

_T = TypeVar("_T")


class Tracking(Iterator[FrameEstimate]):
    """An object on its way through a video: iterate over it for one estimate a frame, or ask for the `result` of all.

    Nothing is computed before the first of both. ``for`` gives each estimate as soon as it is there; ``async for`` does
    so while a thread of its own computes, so that the event loop is not blocked.

    If only the estimates are iterated over, they are not saved, and memory depends on the object and not on the length
    of the video. If ``refine=`` or ``model=`` was given, or `result` is called first, they are saved in a
    temporary run folder, which lives as long as the result.
    """

    def __init__(
        self, request: TrackRequest, keeps: bool, queries: NDArray[np.float64] | None = None
    ) -> None:
        self._request, self._keeps, self._queries = request, keeps, queries
        self._answers: Generator[FrameEstimate] | None = None
        self._kept: TemporaryRun | None = None
        self._result: TrackingResult | None = None

    def __next__(self) -> FrameEstimate:
        """The estimate for the next frame."""
        return next(self._begun(self._keeps))

    def result(self) -> TrackingResult:
        """All estimates and the model: what the command line writes. Goes through the frames that are left.

        Raises:
            InputError: If estimates were taken already and were not saved; if there is no frame.
            Tracking3dError: As in iterating.
        """
        if self._result is None:
            for _ in self._begun(True):
                pass
            if self._kept is None:
                raise InputError(
                    "The estimates that were taken one by one were not saved; call result() first, or give refine= or "
                    "model= to have both."
                )
            self._result = TrackingResult(self._kept, self._request.source, self._queries)
        return self._result

    async def result_async(self) -> TrackingResult:
        """The `result`, computed in a thread of its own.

        If the task is cancelled, the frame in work is finished, and then the source is closed.
        """
        self._begun(True)
        async with _Worker(self) as worker:
            async for _ in worker.all():
                pass
            return await worker.of(self.result)

    def __aiter__(self) -> AsyncIterator[FrameEstimate]:
        """Estimates from a thread; the next frame is taken when the next estimate is asked for."""
        return self._in_thread()

    async def _in_thread(self) -> AsyncIterator[FrameEstimate]:
        async with _Worker(self) as worker:
            async for estimate in worker.all():
                yield estimate

    def close(self) -> None:
        """Stop, and close the source; saved estimates stay."""
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
            self._answers = self._estimates()
        return self._answers

    def _estimates(self) -> Generator[FrameEstimate]:
        following = None if self._queries is None else PointFollowing(self._queries)
        with closing(track_frames(self._request, self._kept)) as tracked:
            for frame, [one], [estimate] in tracked:
                yield estimate if following is None else following.step(one.session, frame, estimate)


class _Worker:
    """A thread that goes through the estimates of a tracking; leaving it waits for the frame in work, and closes."""

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
        """The estimates that are left."""
        while (estimate := await self.of(lambda: next(self._tracking, None))) is not None:
            yield estimate


def track_frames(
    request: TrackRequest, run: TemporaryRun | None = None
) -> Generator[tuple[Frame, tuple[TrackedObject, ...], tuple[FrameEstimate, ...]]]:
    """Track the objects of a request, frame by frame as the caller takes them.

    Args:
        request: What is to be tracked.
        run: Keeps everything about the only object; after the last frame the run is finished as any run is. If None,
            nothing is saved, and an object whose plug-in has failed is estimated as lost from then on.

    Yields:
        Each frame that can be decoded, the objects, and the estimate of each object.

    Raises:
        Tracking3dError: If a frame cannot be used, a prompt does not fit the first one, or the last object has failed.
    """
    with ExitStack() as ends:
        try:
            opened = ends.enter_context(open_tracking(request))
        except NoFrameError:
            if run is None:
                return
            raise
        objects, recording = _ObjectsInStep(opened.objects), None
        unmet = [UnmetCorrections(one.corrections) for one in opened.objects if run is None]
        if run is not None:
            recording = begin_recording(opened, 0, run.folder, RecordOptions(), ends, temporary=True)
        for frame in opened.frames:
            for one in unmet:
                one.see(frame)
            if recording is not None:
                recording.take(frame)
            if not isinstance(frame, Frame):
                continue
            if recording is None:
                yield frame, opened.objects, objects.step(frame)
            elif recording.latest is not None:
                yield frame, opened.objects, (recording.latest,)
        for one in unmet:
            one.warn()
        if recording is not None:
            run_refinement(opened.source, ActiveRecordings([recording]))
    if run is not None:
        run.about_shape = make_final_shape(run.folder, opened.config, opened.source)
        apply_object_size(run.folder, opened.config.object)


class _ObjectsInStep:
    """Objects that take frame after frame together; one whose plug-in has failed is lost from then on."""

    def __init__(self, objects: Sequence[TrackedObject]) -> None:
        self._objects = objects
        self._failures: dict[int, PluginError] = {}
        self._latest: list[FrameEstimate | None] = [None for _ in objects]

    def step(self, frame: Frame) -> tuple[FrameEstimate, ...]:
        """The estimate of each object in the next frame.

        Raises:
            PluginError: If the last object has failed.
        """
        shared, estimates = with_share(frame, len(self._objects)), []
        for number, one in enumerate(self._objects):
            if number not in self._failures:
                try:
                    prompts = prompts_in(shared, one.corrections)
                    self._latest[number] = estimate = one.session.step(shared, *prompts)
                    estimates.append(estimate)
                    continue
                except PluginError as error:
                    self._failures[number] = error
                    if len(self._failures) == len(self._objects):
                        raise
            why, latest = str(self._failures[number]), self._latest[number]
            pose = np.eye(4) if latest is None else latest.T_cam_obj
            lost = lost_estimate(shared, MaskEstimate(None), pose)
            estimates.append(replace(lost, reason=why, failure=why))
        return tuple(estimates)


def _no_frame_error() -> Generator[FrameEstimate]:
    yield from ()
