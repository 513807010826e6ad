"""The first step of a long video: look ahead and cut; or track it whole, where it is one part or was joined before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tracking3d.config.models import PipelineConfig
from tracking3d.pipeline.record import record, select_tracker
from tracking3d.prompts.prompt import make_prompt
from tracking3d.results import layout
from tracking3d.results.overwrite import make_room
from tracking3d.results.run_reader import is_finished
from tracking3d.submaps.cuts import windows
from tracking3d.submaps.job import Ended, LongVideo, Tell, frames_of_part
from tracking3d.submaps.plan import (
    Plan,
    has_plan,
    make_plan,
    part_folder,
    prompt_at,
    read_plan,
    remove_parts,
    selection_of,
)
from tracking3d.submaps.submap_runs import PartJob, begin_session
from tracking3d.video import open_source

BEFORE = "that was found when they were tracked"
"""The reason of parts that an earlier command could not join."""


@dataclass(frozen=True, eq=False)
class Begun:
    """A video that is cut.

    Attributes:
        video: What is tracked.
        config: The pipeline with the mask tracker that was chosen.
        choice: Why it is that one; None where the user named it.
        count: Frames that were asked for.
        plan: Where it is cut.
        jobs: Its parts.
    """

    video: LongVideo
    config: PipelineConfig
    choice: str | None
    count: int
    plan: Plan
    jobs: tuple[PartJob, ...]


def begin(tell: Tell, video: LongVideo) -> Begun | Ended:
    """Cut a video, unless it is one part, or done; ``tell`` is given the answers where it is tracked here.

    Raises:
        InputError: If the video cannot be split, or what is there is of something else.
        Tracking3dError: What was finished until then is kept.
    """
    given, folder, resume = video.given, video.folder, video.resume
    opened = open_source(video.source, video.selection)
    frames = frames_of_part(opened, video.config, video.length)
    one_part = partial(
        record, opened, video.config, folder, box=given.box, mask=given.mask, points=given.points,
        command=video.command, selection=video.selection, overwrite=video.overwrite, resume=resume, listener=tell,
    )  # fmt: skip
    count = opened.count
    assert count is not None
    if not windows(count, frames):
        one_part()
        return Ended((folder,), 1, f"{opened.name} has {count} frames, which is one part")
    if resume and (layout.has_state(folder) or is_there(folder)):  # joined already
        one_part()
        remove_parts(folder)
        return Ended((folder,), 1)
    if not resume:
        make_room(folder, video.overwrite)
        remove_parts(folder)
    first, _ = begin_session(opened, video.config, given)
    prompt = None if given.untold else make_prompt(first, given.box, given.mask, points=given.points)
    config, choice = select_tracker(video.config, opened, first, prompt, folder, resume)
    asked: dict[str, Any] = {
        "count": count, "length": frames, "first": first, "prompt": prompt, "selection": video.selection,
    }  # fmt: skip
    kept = read_plan(config, folder, **asked) if resume else None
    plan = kept or make_plan(opened, config, folder, **asked)
    if len(plan.parts) == 1:
        remove_parts(folder)
        one_part()
        return Ended((folder,), 1, "no frame near to where it was to be cut shows the object well")
    jobs = _part_jobs(video, config, count, plan, resume=kept is not None)
    if kept is not None and all(is_finished(job.folder) for job in jobs):
        return Ended(tuple(job.folder for job in jobs), len(jobs), BEFORE)
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
            prompt_at(video.folder, part, video.given, video.precomputed),
            video.command,
            resume,
        )
        for part in plan.parts
    )
