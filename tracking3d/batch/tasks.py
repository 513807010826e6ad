"""The tasks of a batch: one for a video; for a long one that is cut, one for each step, as those before it end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from tracking3d.batch.in_parts import begin_in_parts, settle_in_parts, step_in_parts
from tracking3d.batch.networks import SharedNetwork
from tracking3d.batch.one_video import log_file, track_video
from tracking3d.batch.video_job import VideoJob
from tracking3d.engines.protocol import Ended, Task
from tracking3d.splitting.steps import Step, Steps, steps_of


@dataclass
class _Long:
    """A video that is cut, while it is worked on."""

    video: int
    steps: Steps | None = None
    answers: dict[int, Any] = field(default_factory=dict)
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
        workers: Of the batch, for the record.
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
        """The number of the video that a task is of."""
        return self._long[task].video if task in self._long else task

    def label(self, task: int) -> str:
        """What a step is called; empty of the first."""
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
        long.answers[ended.number] = ended.value
        if long.waiting:
            return []
        answers = [long.answers[number] for number in sorted(long.answers)]
        try:
            return self._tasks(long, long.steps.send(answers))
        except StopIteration as stop:
            arguments = (self._jobs[long.video], self._out, self._report, stop.value, long.again)
            return [self._task(long, settle_in_parts, arguments, "its report")]

    def _tasks(self, long: _Long, steps: Sequence[Step]) -> list[Task]:
        long.answers.clear()
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
    """Whether a video is finished with a task; steps of long ones answer with other things than its rows."""
    return isinstance(ended.value, Mapping) and "rows" in ended.value
