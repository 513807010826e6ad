"""The last steps of a long video: its parts become one object and one run, which ends as any run does."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tracking3d.checkpoint.resuming import prompt_record
from tracking3d.pipeline.open_tracking import OpenTracking, TrackRequest, open_tracking, request_tracking
from tracking3d.pipeline.passes import run_passes
from tracking3d.pipeline.record import RecordOptions, begin_recording
from tracking3d.pipeline.refinement_steps import PrecomputedRefinement
from tracking3d.prompts.prompt import PromptSet
from tracking3d.reconstruction.final_shape import make_final_shape
from tracking3d.results.description import RunHeader
from tracking3d.results.run_notes import note_in_run
from tracking3d.results.run_reader import RunReader
from tracking3d.results.run_unit import apply_object_size
from tracking3d.results.run_writer import RunWriter
from tracking3d.submaps.alignment import DisagreementError
from tracking3d.submaps.job import Tell
from tracking3d.submaps.merged_run import write_causal_mesh, write_merged_run
from tracking3d.submaps.merging import MergedMap, merge_submaps
from tracking3d.submaps.plan import PARTS, part_folder, put_cut_mask, remove_parts
from tracking3d.submaps.plan_step import Begun
from tracking3d.submaps.submap_runs import PartJob, Revisit
from tracking3d.video import open_source

_log = logging.getLogger(__name__)
_SAME_OBJECT = 0.5
"""If less than this share of the smaller of two masks lies within the other, a part began on something else than the
part before ends with. One of them may well have lost a side of the object."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A video whose parts have their causal estimates."""

    begun: Begun  # the video
    jobs: tuple[PartJob, ...]  # its parts, as they were tracked last
    again: tuple[int, ...] = ()  # numbers of the parts that were tracked again
    seconds: float = 0.0  # what tracking the parts took


@dataclass(frozen=True, eq=False)
class Again:
    """A part that began on something else and is to be tracked once more."""

    number: int
    job: PartJob


@dataclass(frozen=True)
class Refused:
    """Why parts cannot be merged."""

    reason: str


@dataclass(frozen=True, eq=False)
class MergedSubmaps:
    """A video whose parts are one run, but for its second estimates."""

    begun: Begun  # the video
    looks: tuple[Revisit, ...]  # frames to be refined, by parts
    about: Mapping[str, Any]  # the section split of run.json
    seconds: Mapping[str, float] = field(default_factory=dict)  # what each step took, by name


def join(tell: Tell, tracked: Tracked) -> Again | Refused | MergedSubmaps:
    """Merge the parts into one run, up to the refinement of all frames.

    Raises:
        Tracking3dError: If something cannot be read or written; the frames finished until then are saved.
    """
    begun, clock = tracked.begun, time.monotonic()
    video = begun.video
    if (again := _find_running(tracked)) is not None:
        return again
    with open_tracking(_request(begun)) as opened:
        session = opened.objects[0].session
    try:
        whole = merge_submaps(session, begun.config, begun.plan, video.folder)
    except DisagreementError as error:
        _log.warning("The parts could not be merged: %s.", error)
        return Refused(str(error))
    seconds = {"preview": begun.plan.seconds, "parts": tracked.seconds}
    seconds["merge"], clock = time.monotonic() - clock, time.monotonic()
    about = {
        "workers": video.workers,
        "parts": [[run.part.start, run.part.stop] for run in whole.runs],
        "preview_frames": begun.plan.preview_frames,
        "retracked": list(tracked.again),
        "alignments": whole.alignments,
        "cost_ratio": whole.cost_ratio,
    }
    writer = _begin_writing(begun, opened, whole)
    owned = _owned_ranges(begun)
    session.load_state_dict(opened.first, whole.session, {})
    write_causal_mesh(video.folder, session)
    session.refine()
    write_merged_run(writer, session, whole.runs, owned, sum(seconds.values()) + time.monotonic() - clock)
    seconds["refine"] = time.monotonic() - clock
    note_in_run(video.folder, {"split": {**about, "seconds": seconds}})
    return MergedSubmaps(begun, _revisits(begun, owned), about, seconds)


@dataclass(frozen=True, eq=False)
class Ending:
    """A video whose frames are all estimated, to be drawn."""

    merged: MergedSubmaps  # the run; its seconds are those of all steps
    precomputed: PrecomputedRefinement  # what the last steps of its final refinement come to


def end(tell: Tell, ending: Ending) -> None:
    """Draw the estimates, and write the final files; the parts are removed.

    Args:
        tell: Called with the estimates that are drawn.
        ending: All that is known.

    Raises:
        Tracking3dError: If something cannot be read or written; the frames finished until then are saved.
    """
    begun = ending.merged.begun
    video, config = begun.video, begun.config
    about = {**ending.merged.about, "seconds": dict(ending.merged.seconds)}
    note_in_run(video.folder, {"split": about})
    options = RecordOptions(video.command, video.selection, resume=True)
    with open_tracking(_request(begun)) as opened, ExitStack() as writers:
        opened = replace(opened, tracker_choice=begun.choice)
        recording = begin_recording(opened, 0, video.folder, options, writers)
        if recording is not None:
            recording.precomputed = ending.precomputed
            run_passes(opened.source, opened.frames, [recording], tell)
    if recording is not None:
        make_final_shape(video.folder, config, opened.source)
    apply_object_size(video.folder, config.object)
    remove_parts(video.folder)


def _request(begun: Begun) -> TrackRequest:
    """The whole video, with the mask tracker that was chosen."""
    video = begun.video
    source = open_source(video.source, video.selection)
    return request_tracking(source, begun.config, video.prompts, skip_damaged=True)


def _find_running(tracked: Tracked) -> Again | None:
    """The first part that began on something else than the part before ends with, and was not tracked again yet."""
    begun = tracked.begun
    folder, whole = begun.video.folder, begun.video.frames(begun.count)
    checked = max(tracked.again, default=0)
    for before, part in zip(begun.plan.parts, begun.plan.parts[1:], strict=False):
        if part.number <= checked:
            continue
        cut = whole[part.start]
        earlier = RunReader(part_folder(folder, before), refined=False)
        estimates = {one.index: one for one in earlier.frames}
        prompts = tracked.jobs[part.number].prompts
        began = prompts.masks[0] if prompts.masks else None
        if (
            cut not in estimates
            or estimates[cut].status != "tracked"
            or began is None
            or isinstance(began, Path)
        ):
            continue
        estimate = earlier.mask(cut)
        smaller = min(estimate.sum(), began.sum())
        if smaller and np.count_nonzero(estimate & began) < _SAME_OBJECT * smaller:
            _log.warning("Part %d began on something else and is tracked again.", part.number + 1)
            put_cut_mask(folder, part, estimate)
            job = replace(tracked.jobs[part.number], prompts=PromptSet.of_one(mask=estimate), resume=False)
            return Again(part.number, job)
    return None


def _owned_ranges(begun: Begun) -> list[range]:
    """Indices of the frames whose estimates are taken from each part."""
    whole = begun.video.frames(begun.count)
    starts = [part.owns_from for part in begun.plan.parts]
    return [whole[start:stop] for start, stop in zip(starts, [*starts[1:], len(whole)], strict=True)]


def _begin_writing(begun: Begun, opened: OpenTracking, whole: MergedMap) -> RunWriter:
    """The writer of the merged run, with the header of a run before its first frame."""
    video, source, [one] = begun.video, opened.source, opened.objects
    header = RunHeader(
        config=begun.config.model_dump(mode="json"),
        camera=whole.camera,
        source=source.name,
        seed=begun.config.runtime.seed,
        renderer=one.session.renderer,
        fps=source.fps,
        command=video.command,
        selection=video.selection,
        given=prompt_record(opened.first, one.prompt, source.count),
        tracker_choice=begun.choice,
    )
    return RunWriter(video.folder, header, overwrite=True)


def _revisits(begun: Begun, owned: Sequence[range]) -> tuple[Revisit, ...]:
    video = begun.video
    return tuple(
        Revisit(
            video.source,
            video.selection,
            f"{mine.start}:{mine[-1] + 1}:{mine.step}",
            begun.config,
            video.folder,
            video.prompts,
            video.folder / PARTS / f"second_{part.number}",
        )
        for part, mine in zip(begun.plan.parts, owned, strict=True)
    )
