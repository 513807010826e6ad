"""What workers do for a long video of a batch: cut it, do one step of it, and put into its place what became of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tracking3d.batch.networks import SharedNetwork
from tracking3d.batch.one_video import RUN, begun_before, counted, counting, fetched, put_away, worked_on
from tracking3d.batch.video_job import VideoJob
from tracking3d.engines.protocol import Tell
from tracking3d.point_prompts import parse_points
from tracking3d.prompts import PromptSet, parse_box
from tracking3d.splitting.beginning import Begun, begin
from tracking3d.splitting.long_video import LongVideo, SplitResult
from tracking3d.splitting.steps import Step


def begin_in_parts(
    tell: Tell,
    job: VideoJob,
    out: str,
    command: str,
    report: bool,
    workers: int,
    networks: tuple[SharedNetwork, ...] = (),
) -> Begun | dict[str, Any]:
    """Cut a video; one that is a single part is tracked here, and what `put_away` returns is the answer.

    Args:
        tell: See `tracking3d.batch.one_video.track_video`.
        job: The video.
        out: The folder of the batch.
        command: The command line, for the record.
        report: Whether to write a report.
        workers: Of the batch, for the record.
        networks: What the machine may lack.

    Raises:
        Tracking3dError: If it cannot be cut or tracked; what is finished is kept for another time.
    """
    with worked_on(job, out, networks) as work:
        attempts = counted(work)
        begun = begin(counting(tell, None), _video(fetched(job, work / "source"), work, command, workers))
        if isinstance(begun, SplitResult):
            return put_away(job, out, work, begun.folders, report, attempts, _note(begun))
        return begun


def step_in_parts(
    tell: Tell, job: VideoJob, out: str, step: Step, whole: int, networks: tuple[SharedNetwork, ...] = ()
) -> Any:
    """Do one step; its answer.

    Args:
        tell: See `tracking3d.batch.one_video.track_video`; ``share`` is that of the whole video.
        job: The video.
        out: The folder of the batch.
        step: What is to be done.
        whole: Answers of the whole video.
        networks: What the machine may lack.

    Raises:
        Tracking3dError: If it fails; what is finished is kept for another time.
    """

    def with_share(content: dict[str, Any]) -> None:
        tell({**content, "share": content["frames"] / whole})

    with worked_on(job, out, networks):
        return step.function(counting(with_share, step.frames or None, step=step.label), step.argument)


def settle_in_parts(
    tell: Tell, job: VideoJob, out: str, report: bool, ended: SplitResult, again: int
) -> dict[str, Any]:
    """Put what became of a video into its place.

    Args:
        tell: Is not used.
        job: The video.
        out: The folder of the batch.
        report: Whether to write reports.
        ended: Its run, or its parts'.
        again: How often steps of it were tried again.

    Raises:
        OutputError: If something cannot be written.
    """
    with worked_on(job, out) as work:
        attempts = max(begun_before(work), 1) + again
        return put_away(job, out, work, ended.folders, report, attempts, _note(ended))


def _video(job: VideoJob, work: Path, command: str, workers: int) -> LongVideo:
    prompts = PromptSet.of_one(
        next(map(parse_box, job.box), None),
        next(map(Path, job.mask), None),
        next(map(parse_points, job.points), None),
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
    return f"its {ended.parts} parts could not be joined: {ended.reason}" if len(ended.folders) > 1 else ""
