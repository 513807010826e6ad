"""The first step of a long video: preview and cut; or track it whole, if it is one part or could not be merged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tracking3d.config.models import PipelineConfig
from tracking3d.pipeline.open_tracking import open_tracking, request_tracking
from tracking3d.pipeline.record import RecordOptions, record_tracking
from tracking3d.results import layout
from tracking3d.results.overwrite import clear_run_folder
from tracking3d.results.run_reader import is_finished
from tracking3d.submaps.cuts import windows
from tracking3d.submaps.job import LongVideo, SplitResult, Tell, frames_of_part
from tracking3d.submaps.plan import (
    Plan,
    has_plan,
    make_plan,
    part_folder,
    prompts_at,
    read_plan,
    remove_parts,
    selection_of,
)
from tracking3d.submaps.submap_runs import PartJob
from tracking3d.video import open_source

BEFORE = "that was found when they were tracked"
"""The reason for parts that an earlier command could not merge."""


@dataclass(frozen=True, eq=False)
class Begun:
    """A video that is cut."""

    video: LongVideo  # what is tracked
    config: PipelineConfig  # the pipeline with the mask tracker that was chosen
    choice: str | None  # why it is that one; None if the user named it
    count: int  # frames that were asked for
    plan: Plan  # the plan of its parts
    jobs: tuple[PartJob, ...]  # its parts


def begin(tell: Tell, video: LongVideo) -> Begun | SplitResult:
    """Cut a video, unless it is one part, or done; ``tell`` is given the estimates if it is tracked here.

    Raises:
        InputError: If the video cannot be split, or the folder holds another run.
        Tracking3dError: The frames finished until then are saved.
    """
    folder, resume = video.folder, video.resume
    opened = open_source(video.source, video.selection)
    frames = frames_of_part(opened, video.config, video.length)
    request = request_tracking(opened, video.config, video.prompts)
    options = RecordOptions(video.command, video.selection, video.overwrite, resume)
    count = opened.count
    assert count is not None
    if not windows(count, frames):
        record_tracking(request, folder, options, tell)
        return SplitResult((folder,), 1, f"{opened.name} has {count} frames, which is one part")
    if resume and (layout.has_state(folder) or is_there(folder)):  # merged already
        record_tracking(request, folder, options, tell)
        remove_parts(folder)
        return SplitResult((folder,), 1)
    if not resume:
        clear_run_folder(folder, video.overwrite)
        remove_parts(folder)
    with open_tracking(replace(request, skip_damaged=True), folder if resume else None) as tracking:
        config, choice, first = tracking.config, tracking.tracker_choice, tracking.first
        prompt = tracking.objects[0].prompt
    asked: dict[str, Any] = {
        "count": count, "length": frames, "first": first, "prompt": prompt, "selection": video.selection,
    }  # fmt: skip
    kept = read_plan(config, folder, **asked) if resume else None
    plan = kept or make_plan(opened, config, folder, **asked)
    if len(plan.parts) == 1:
        remove_parts(folder)
        record_tracking(request, folder, options, tell)
        return SplitResult((folder,), 1, "no frame near the planned cut shows the object well")
    jobs = _part_jobs(video, config, count, plan, resume=kept is not None)
    if kept is not None and all(is_finished(job.folder) for job in jobs):
        return SplitResult(tuple(job.folder for job in jobs), len(jobs), BEFORE)
    return Begun(video, config, choice, count, plan, jobs)


def is_there(folder: Path) -> bool:
    """Whether a folder holds a run that parts have nothing more to add to."""
    return (folder / layout.RUN).is_file() and not has_plan(folder)


def _part_jobs(
    video: LongVideo, config: PipelineConfig, count: int, plan: Plan, *, resume: bool
) -> tuple[PartJob, ...]:
    return tuple(
        PartJob(
            video.source,
            selection_of(video.frames(count), part.start, part.stop),
            config,
            part_folder(video.folder, part),
            prompts_at(video.folder, part, video.prompts, video.precomputed),
            video.command,
            resume,
        )
        for part in plan.parts
    )
