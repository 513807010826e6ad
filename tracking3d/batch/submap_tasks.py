"""Tasks for a long video of a batch: cut it into submaps, do one step, and move the result into place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tracking3d.batch.networks import SharedNetwork
from tracking3d.batch.one_video import (
    RUN,
    count_attempt,
    count_earlier_attempts,
    counting,
    fetch_inputs,
    local_work_folder,
    put_away,
)
from tracking3d.batch.video_job import VideoJob
from tracking3d.engines.protocol import Tell
from tracking3d.prompts.boxes import parse_box
from tracking3d.prompts.points import parse_points
from tracking3d.prompts.prompt import PromptSet
from tracking3d.submaps.job import LongVideo, SplitResult
from tracking3d.submaps.plan_step import Begun, begin
from tracking3d.submaps.steps import Step


def begin_in_parts(
    tell: Tell,
    job: VideoJob,
    out: str,
    command: str,
    report: bool,
    workers: int,
    networks: tuple[SharedNetwork, ...] = (),
) -> Begun | dict[str, Any]:
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
        begun = begin(
            counting(tell, None), _video(fetch_inputs(job, work / "source"), work, command, workers)
        )
        if isinstance(begun, SplitResult):
            return put_away(job, out, work, begun.folders, report, attempts, _note(begun))
        return begun


def step_in_parts(
    tell: Tell, job: VideoJob, out: str, step: Step, whole: int, networks: tuple[SharedNetwork, ...] = ()
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
    tell: Tell, job: VideoJob, out: str, report: bool, ended: SplitResult, again: int
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
        job.video,
        job.config,
        work / RUN,
        prompts,
        job.split,
        workers,
        job.frames,
        command,
        resume=True,
    )


def _note(ended: SplitResult) -> str:
    return f"its {ended.parts} parts could not be merged: {ended.reason}" if len(ended.folders) > 1 else ""
