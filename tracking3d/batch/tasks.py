"""The tasks of a batch: one per video; for a long video that is cut, one per step, as the earlier ones finish."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from tracking3d.batch.one_video import (
    RUN,
    count_attempt,
    count_earlier_attempts,
    counting,
    fetch_inputs,
    local_work_folder,
    log_file,
    put_away,
    track_video,
)
from tracking3d.batch.video_job import SharedNetwork, VideoJob
from tracking3d.engines.protocol import Ended, Reporter, Task
from tracking3d.pipeline.submaps.job import LongVideo, SplitResult
from tracking3d.pipeline.submaps.plan import PlannedVideo, plan_video
from tracking3d.pipeline.submaps.split_run import Step, Steps, steps_of
from tracking3d.trackers.prompts.boxes import parse_box
from tracking3d.trackers.prompts.points import parse_points
from tracking3d.trackers.prompts.prompt import PromptSet


@dataclass
class _Long:
    """A video that is cut, while it is worked on."""

    video: int
    steps: Steps | None = None
    results: dict[int, Any] = field(default_factory=dict)
    waiting: set[int] = field(default_factory=set)
    whole: int = 1
    again: int = 0
    failed: bool = False


class Tasks:
    """Which task is of which video, and what follows it.

    Args:
        jobs: All videos.
        out: The folder of the batch.
        command: The command line, for the record.
        report: Whether runs get reports.
        workers: Number of workers of the batch, for the record.
        networks: What machines may lack.
    """

    def __init__(
        self,
        jobs: Sequence[VideoJob],
        out: str,
        command: str,
        report: bool,
        workers: int,
        networks: tuple[SharedNetwork, ...],
    ) -> None:
        self._jobs, self._out, self._command, self._report = jobs, out, command, report
        self._workers, self._networks = workers, networks
        self._numbers = count(len(jobs))
        self._long: dict[int, _Long] = {}
        self._labels: dict[int, str] = {}

    def first(self, video: int) -> Task:
        """What is to be done first for a video, by its number; the task has the same."""
        job = self._jobs[video]
        arguments: tuple[Any, ...] = (job, self._out, self._command, self._report)
        if not job.in_parts:
            return Task(video, track_video, (*arguments, self._networks), log_file(self._out, job))
        self._long[video] = _Long(video, waiting={video})
        arguments = (*arguments, self._workers, self._networks)
        return Task(video, begin_in_parts, arguments, log_file(self._out, job))

    def video(self, task: int) -> int:
        """The number of a task's video."""
        return self._long[task].video if task in self._long else task

    def label(self, task: int) -> str:
        """The name of a step; empty for the first."""
        return self._labels.get(task, "")

    def further(self, ended: Ended) -> list[Task]:
        """What is to be done after a task that has ended for good."""
        long = self._long.get(ended.number)
        if long is None or ended.fault is not None or long.failed or is_finished_video(ended):
            if long is not None:
                long.failed |= ended.fault is not None
            return []
        long.again += ended.attempts - 1
        long.waiting.discard(ended.number)
        if long.steps is None:
            long.steps, long.whole = steps_of(ended.value), 2 * ended.value.count
            return self._tasks(long, next(long.steps))
        long.results[ended.number] = ended.value
        if long.waiting:
            return []
        results = [long.results[number] for number in sorted(long.results)]
        try:
            return self._tasks(long, long.steps.send(results))
        except StopIteration as stop:
            arguments = (self._jobs[long.video], self._out, self._report, stop.value, long.again)
            return [self._task(long, settle_in_parts, arguments, "its report")]

    def _tasks(self, long: _Long, steps: Sequence[Step]) -> list[Task]:
        long.results.clear()
        job = self._jobs[long.video]
        return [
            self._task(long, step_in_parts, (job, self._out, step, long.whole, self._networks), step.label)
            for step in steps
        ]

    def _task(self, long: _Long, function: Any, arguments: tuple[Any, ...], label: str) -> Task:
        number = next(self._numbers)
        self._long[number], self._labels[number] = long, label
        long.waiting.add(number)
        return Task(number, function, arguments, log_file(self._out, self._jobs[long.video]))


def is_finished_video(ended: Ended) -> bool:
    """Whether a video is finished with a task; steps of long ones estimate with other things than its rows."""
    return isinstance(ended.value, Mapping) and "rows" in ended.value


def begin_in_parts(
    tell: Reporter,
    job: VideoJob,
    out: str,
    command: str,
    report: bool,
    workers: int,
    networks: tuple[SharedNetwork, ...] = (),
) -> PlannedVideo | dict[str, Any]:
    """Cut a video; a video that is a single submap is tracked here, and the result is that of `put_away`.

    Args:
        tell: See `tracking3d.batch.one_video.track_video`.
        job: The video.
        out: The folder of the batch.
        command: The command line, for the record.
        report: Whether to write a report.
        workers: Number of workers of the batch, for the record.
        networks: What the machine may lack.

    Raises:
        Tracking3dError: If it cannot be cut or tracked; finished frames are kept for the next attempt.
    """
    with local_work_folder(job, out, networks) as work:
        attempts = count_attempt(work)
        planned = plan_video(
            counting(tell, None), _video(fetch_inputs(job, work / "source"), work, command, workers)
        )
        if isinstance(planned, SplitResult):
            return put_away(job, out, work, planned.folders, report, attempts, _note(planned))
        return planned


def step_in_parts(
    tell: Reporter, job: VideoJob, out: str, step: Step, whole: int, networks: tuple[SharedNetwork, ...] = ()
) -> Any:
    """Do one step and return its result.

    Args:
        tell: See `tracking3d.batch.one_video.track_video`; ``share`` is that of the whole video.
        job: The video.
        out: The folder of the batch.
        step: What is to be done.
        whole: Estimates of the whole video.
        networks: What the machine may lack.

    Raises:
        Tracking3dError: If it fails; finished frames are kept for the next attempt.
    """

    def with_share(content: dict[str, Any]) -> None:
        tell({**content, "share": content["frames"] / whole})

    with local_work_folder(job, out, networks):
        return step.function(counting(with_share, step.frames or None, step=step.label), step.argument)


def settle_in_parts(
    tell: Reporter, job: VideoJob, out: str, report: bool, ended: SplitResult, again: int
) -> dict[str, Any]:
    """Put what became of a video into its place.

    Args:
        tell: Not used.
        job: The video.
        out: The folder of the batch.
        report: Whether to write reports.
        ended: Its run, or its parts'.
        again: How often steps of it were tried again.

    Raises:
        OutputError: If something cannot be written.
    """
    with local_work_folder(job, out) as work:
        attempts = max(count_earlier_attempts(work), 1) + again
        return put_away(job, out, work, ended.folders, report, attempts, _note(ended))


def _video(job: VideoJob, work: Path, command: str, workers: int) -> LongVideo:
    prompts = PromptSet(
        [parse_box(text, box_format=job.box_format) for text in job.box],
        [Path(file) for file in job.mask],
        [parse_points(text) for text in job.points],
        box_format=job.box_format,
    )
    return LongVideo(
        job.video, job.config, work / RUN, prompts, job.split, workers, job.frames, command, resume=True
    )


def _note(ended: SplitResult) -> str:
    return f"its {ended.parts} parts could not be merged: {ended.reason}" if len(ended.folders) > 1 else ""
