"""A long video in parts: look ahead, cut, track side by side, join, look again side by side, and end as one run."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tracking3d.config.models import PipelineConfig
from tracking3d.frames import SkippedFrame
from tracking3d.passes import Listener
from tracking3d.prompts import PromptSet
from tracking3d.results.records import FrameRecord
from tracking3d.splitting.beginning import begin
from tracking3d.splitting.long_video import LongVideo, SplitResult
from tracking3d.splitting.processes import run_in_processes
from tracking3d.splitting.steps import Step, steps_of

SideBySide = Callable[..., list[Any]]
"""See `run_in_processes`."""


def record_in_parts(
    source: str | Path,
    config: PipelineConfig,
    folder: Path,
    prompts: PromptSet,
    *,
    length: str,
    workers: int = 2,
    selection: str | None = None,
    command: str | None = None,
    overwrite: bool = False,
    resume: bool = False,
    listener: Listener = lambda frame: None,
    map_jobs: SideBySide | None = None,
) -> SplitResult:
    """Track a long video in parts, side by side, and write one run folder; see the module.

    Parts that cannot be joined are finished each by itself, in folders within ``folder``. What there is only one of is
    done in this process.

    Args:
        source: A video file, or a folder or pattern of images.
        config: The pipeline; of the solver ``online``, with its final refinement.
        folder: The run folder.
        prompts: What the object is in the first frame.
        length: Of a part, in seconds or frames, see `tracking3d.splitting.cutting.parse_length`.
        workers: Processes at a time.
        selection: ``START:STOP:STEP`` of the frames.
        command: For the record.
        overwrite: Replace a run that is in the folder.
        resume: Go on with what is there.
        listener: Is told of every answer, the first ones and those of the refinement.
        map_jobs: What takes the place of `run_in_processes` with so many workers.

    Raises:
        InputError: If the video cannot be split, or what is there is of something else.
        Tracking3dError: What was finished until then is kept, for ``resume``.
    """
    video = LongVideo(
        str(source), config, folder, prompts, length, workers, selection, command, overwrite, resume
    )
    told, map_jobs = _once(listener), map_jobs or partial(run_in_processes, workers=workers)
    begun = begin(told, video)
    if isinstance(begun, SplitResult):
        return begun
    steps = steps_of(begun)
    answers: list[Any] | None = None
    while True:
        try:
            wanted = next(steps) if answers is None else steps.send(answers)
        except StopIteration as stop:
            ended: SplitResult = stop.value
            return ended
        answers = map_jobs(take_step, wanted, told=told)


def take_step(tell: Callable[[Any], None], step: Step) -> Any:
    """Do one step in this process."""
    return step.function(tell, step.argument)


def _once(listener: Listener) -> Listener:
    """Frames of two parts, and answers that are only drawn again, are told once."""
    told: set[tuple[int, bool]] = set()

    def tell(frame: FrameRecord | SkippedFrame) -> None:
        key = frame.index, isinstance(frame, FrameRecord) and frame.refined
        if key not in told:
            told.add(key)
            listener(frame)

    return tell
