"""A long video in parts: look ahead, cut, track side by side, join, look again side by side, and end as one run."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.checkpoint.resuming import given_of
from tracking3d.config.models import PipelineConfig
from tracking3d.config.solvers import OnlineConfig
from tracking3d.errors import InputError
from tracking3d.frames import Frame, SkippedFrame
from tracking3d.passes import Listener
from tracking3d.prompts import make_prompt
from tracking3d.recording import record, with_tracker
from tracking3d.results import layout
from tracking3d.results.making_room import make_room
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader, is_finished
from tracking3d.results.run_writer import RunWriter
from tracking3d.session import Session
from tracking3d.splitting.agreement import DisagreementError
from tracking3d.splitting.cutting import parse_length, windows
from tracking3d.splitting.joined_run import (
    note_in_run,
    take_second_answers,
    write_causal_mesh,
    write_joined,
)
from tracking3d.splitting.joining import Whole, joined_parts
from tracking3d.splitting.part_runs import (
    Given,
    PartJob,
    SecondLook,
    begin_session,
    look_again,
    track_part,
)
from tracking3d.splitting.plan import (
    PARTS,
    Plan,
    given_at,
    has_plan,
    kept_plan,
    make_plan,
    part_folder,
    put_cut_mask,
    remove_parts,
    selection_of,
)
from tracking3d.splitting.processes import side_by_side
from tracking3d.video import open_source
from tracking3d.video.selection import parse_selection
from tracking3d.video.source import FrameSource

_log = logging.getLogger(__name__)
_SAME_OBJECT = 0.5
"""Share of the smaller one of two masks that lies within the other, below which a part began on something else than the
part before ends with. One of them may well have lost a side of the object."""

SideBySide = Callable[..., list[Any]]
"""See `side_by_side`."""


@dataclass(frozen=True)
class Ended:
    """What became of a video that was to be split.

    Attributes:
        folders: Its run folder, or those of its parts where they could not be joined.
        parts: How many there were.
        reason: Why they could not be joined, or why it was not cut; empty where it was.
    """

    folders: tuple[Path, ...]
    parts: int
    reason: str = ""


@dataclass(frozen=True, eq=False)
class _Video:
    """What is to be tracked, as the steps below share it."""

    source: str
    opened: FrameSource
    selection: str | None
    whole: range
    asked: PipelineConfig
    config: PipelineConfig
    choice: str | None
    folder: Path
    given: Given
    first: Frame
    command: str | None
    map: SideBySide
    listener: Listener
    resume: bool

    @property
    def precomputed(self) -> bool:
        return self.config.tracker.name == "precomputed"


def record_in_parts(
    source: str | Path,
    config: PipelineConfig,
    folder: Path,
    given: Given,
    *,
    length: str,
    workers: int = 2,
    selection: str | None = None,
    command: str | None = None,
    overwrite: bool = False,
    resume: bool = False,
    listener: Listener = lambda frame: None,
    map_jobs: SideBySide | None = None,
) -> Ended:
    """Track a long video in parts, side by side, and write one run folder; see the module.

    Parts that cannot be joined are finished each by itself, in folders within ``folder``.

    Args:
        source: A video file, or a folder or pattern of images.
        config: The pipeline; of the solver ``online``, with its final refinement.
        folder: The run folder.
        given: What the object is in the first frame.
        length: Of a part, in seconds or frames, see `parse_length`.
        workers: Processes at a time.
        selection: ``START:STOP:STEP`` of the frames.
        command: For the record.
        overwrite: Replace a run that is in the folder.
        resume: Go on with what is there.
        listener: Is told of every answer, the first ones and those of the refinement.
        map_jobs: What takes the place of `side_by_side` with so many workers.

    Raises:
        InputError: If the video cannot be split, or what is there is of something else.
        Tracking3dError: What was finished until then is kept, for ``resume``.
    """
    began = time.monotonic()
    opened = open_source(str(source), selection)
    frames = _frames_of_part(opened, config, length)
    one_part = partial(
        record, opened, config, folder, box=given.box, mask=given.mask, points=given.points, command=command,
        selection=selection, overwrite=overwrite, resume=resume, listener=listener,
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
        make_room(folder, overwrite)
        remove_parts(folder)
    first, _ = begin_session(opened, config, given)
    prompt = None if given.untold else make_prompt(first, given.box, given.mask, points=given.points)
    own, choice = with_tracker(config, opened, first, prompt, folder, resume)
    asked: dict[str, Any] = {
        "count": count, "length": frames, "first": first, "prompt": prompt, "selection": selection,
    }  # fmt: skip
    plan = kept_plan(own, folder, **asked) if resume else None
    resume = plan is not None
    plan = plan or make_plan(opened, own, folder, **asked)
    if len(plan.parts) == 1:
        remove_parts(folder)
        one_part()
        return Ended((folder,), 1, "no frame near to where it was to be cut shows the object well")
    wanted = parse_selection(selection)
    whole = range(wanted.start, wanted.start + count * wanted.step, wanted.step)
    video = _Video(
        str(source), opened, selection, whole, config, own, choice, folder, given, first, command,
        map_jobs or partial(side_by_side, workers=workers), _once(listener), resume,
    )  # fmt: skip
    return _tracked(video, plan, began, workers)


def is_there(folder: Path) -> bool:
    """Whether a folder holds a run that parts have nothing more to add to."""
    return (folder / layout.RUN).is_file() and not has_plan(folder)


def _frames_of_part(source: FrameSource, config: PipelineConfig, length: str) -> int:
    """How many frames a part is to have.

    Raises:
        InputError: If the video cannot be split.
    """
    if not isinstance(config.solver, OnlineConfig) or not config.solver.final_refine:
        raise InputError(
            "Parts of a video are joined in the final refinement of the solver online; leave out --split, or what "
            "chooses otherwise (solver.name, solver.final_refine, --quality draft)."
        )
    if not source.repeatable:
        raise InputError(f"{source.name} comes once only and cannot be split; leave out --split.")
    frames = parse_length(length, source.fps)
    if source.count is None:
        raise InputError(f"{source.name} does not tell how many frames it has; leave out --split.")
    return frames


def _once(listener: Listener) -> Listener:
    """Frames of two parts, and answers that are only drawn again, are told once."""
    told: set[tuple[int, bool]] = set()

    def tell(frame: FrameRecord | SkippedFrame) -> None:
        key = frame.index, isinstance(frame, FrameRecord) and frame.refined
        if key not in told:
            told.add(key)
            listener(frame)

    return tell


def _tracked(video: _Video, plan: Plan, began: float, workers: int) -> Ended:
    """The parts tracked, and what came of them."""
    seconds = {"look_ahead": plan.seconds}
    clock = time.monotonic()
    jobs = _part_jobs(video, plan, video.resume)
    if video.resume and all(is_finished(job.folder) for job in jobs):
        return Ended(tuple(job.folder for job in jobs), len(jobs), "that was found when they were tracked")
    video.map(track_part, jobs, told=video.listener)
    again = _begun_elsewhere(video, plan, jobs)
    seconds["parts"], clock = time.monotonic() - clock, time.monotonic()
    first, session = begin_session(video.opened, video.config, video.given)
    try:
        whole = joined_parts(session, video.config, plan, video.folder)
    except DisagreementError as error:
        _log.warning("The parts could not be joined: %s.", error)
        video.map(track_part, _finishing(jobs), told=video.listener)
        return Ended(tuple(job.folder for job in jobs), len(jobs), str(error))
    seconds["join"], clock = time.monotonic() - clock, time.monotonic()
    about = {
        "workers": workers,
        "parts": [[run.part.start, run.part.stop] for run in whole.runs],
        "looked_at": plan.looked_at,
        "tracked_again": again,
        "joints": whole.joints,
        "dearer": whole.dearer,
    }
    writer = _begin_writing(video, session, whole)
    owned = _owned(video, plan)
    session.resume(first, whole.session, {})
    write_causal_mesh(video.folder, session)
    refining = time.monotonic()
    session.refine()
    write_joined(writer, session, whole.runs, owned, time.monotonic() - began)
    seconds["refine"], clock = time.monotonic() - refining, time.monotonic()
    looks = _second_looks(video, plan, owned)
    video.map(look_again, looks, told=video.listener)
    seconds["second_look"] = time.monotonic() - clock
    note_in_run(video.folder, {"split": {**about, "seconds": seconds}})
    take_second_answers(video.folder, session, [look.out for look in looks], time.monotonic() - refining)
    _finish(video)
    remove_parts(video.folder)
    return Ended((video.folder,), len(plan.parts))


def _part_jobs(video: _Video, plan: Plan, resume: bool) -> list[PartJob]:
    return [
        PartJob(
            video.source,
            selection_of(video.whole, part.start, part.stop),
            video.config,
            part_folder(video.folder, part),
            given_at(video.folder, part, video.given, video.precomputed),
            video.command,
            resume,
        )
        for part in plan.parts
    ]


def _finishing(jobs: Sequence[PartJob]) -> list[PartJob]:
    return [replace(job, resume=True, first_pass_only=False) for job in jobs]


def _begun_elsewhere(video: _Video, plan: Plan, jobs: list[PartJob]) -> list[int]:
    """Track parts again that began on something else than the part before ends with; their numbers."""
    again = []
    for before, part in zip(plan.parts, plan.parts[1:], strict=False):
        cut = video.whole[part.start]
        earlier = RunReader(part_folder(video.folder, before), refined=False)
        answers = {one.index: one for one in earlier.frames}
        begun = jobs[part.number].given.mask
        if cut not in answers or answers[cut].status != "tracked" or begun is None or isinstance(begun, Path):
            continue
        answer = earlier.mask(cut)
        smaller = min(answer.sum(), begun.sum())
        if smaller and np.count_nonzero(answer & begun) < _SAME_OBJECT * smaller:
            _log.warning("Part %d began on something else and is tracked again.", part.number + 1)
            put_cut_mask(video.folder, part, answer)
            jobs[part.number] = replace(jobs[part.number], given=Given(mask=answer), resume=False)
            video.map(track_part, [jobs[part.number]], told=video.listener)
            again.append(part.number)
    return again


def _owned(video: _Video, plan: Plan) -> list[range]:
    """Indices of the frames that each part answers for."""
    starts = [part.owns_from for part in plan.parts]
    stops = [*starts[1:], len(video.whole)]
    return [video.whole[start:stop] for start, stop in zip(starts, stops, strict=True)]


def _begin_writing(video: _Video, session: Session, whole: Whole) -> RunWriter:
    """The writer of the joined run, with all that a run knows of itself before its first frame."""
    given = video.given
    prompt = None if given.untold else make_prompt(video.first, given.box, given.mask, points=given.points)
    return RunWriter(
        video.folder,
        config=video.config.model_dump(mode="json"),
        camera=whole.camera,
        source=video.opened.name,
        seed=video.config.runtime.seed,
        renderer=session.renderer,
        fps=video.opened.fps,
        command=video.command,
        selection=video.selection,
        given=given_of(video.first, prompt, video.opened.count),
        tracker_choice=video.choice,
        overwrite=True,
    )


def _second_looks(video: _Video, plan: Plan, owned: Sequence[range]) -> list[SecondLook]:
    return [
        SecondLook(
            video.source,
            video.selection,
            f"{mine.start}:{mine[-1] + 1}:{mine.step}",
            video.config,
            video.folder,
            video.given,
            video.folder / PARTS / f"second_{part.number}",
        )
        for part, mine in zip(plan.parts, owned, strict=True)
    ]


def _finish(video: _Video) -> None:
    """Draw what is answered, and write what is made at the end."""
    given = video.given
    record(
        video.opened, video.asked, video.folder, box=given.box, mask=given.mask, points=given.points,
        command=video.command, selection=video.selection, resume=True, skip_damaged=True, listener=video.listener,
    )  # fmt: skip
