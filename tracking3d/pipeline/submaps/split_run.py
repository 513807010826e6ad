"""A long video in parts: preview, cut, track in parallel, merge, refine in parallel, and finish as one run."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from tracking3d.config.models import PipelineConfig
from tracking3d.engines.mapping import map_tasks
from tracking3d.engines.processes import ProcessEngine
from tracking3d.engines.protocol import Ended, Event, ProgressReport, Reporter, Task
from tracking3d.errors import Tracking3dError
from tracking3d.frames import SkippedFrame
from tracking3d.pipeline.passes import Listener
from tracking3d.pipeline.refinement_steps import PrecomputedRefinement
from tracking3d.pipeline.submaps import merge_step
from tracking3d.pipeline.submaps.job import LongVideo, SplitResult
from tracking3d.pipeline.submaps.plan import PlannedVideo, plan_video
from tracking3d.pipeline.submaps.submap_runs import PartJob, Revisit, refine_submap, track_part
from tracking3d.results.records import FrameRecord
from tracking3d.trackers.prompts.prompt import PromptSet

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

    Parts that cannot be merged are finished each by itself, in folders within ``folder``. What there is only one of is
    done in this process.

    Args:
        source: A video file, or a folder or pattern of images.
        config: The pipeline, with the solver ``online`` and its final refinement.
        folder: The run folder.
        prompts: What the object is in the first frame.
        length: Length of a part, in seconds or frames, see `tracking3d.pipeline.submaps.cuts.parse_length`.
        workers: Processes at a time.
        selection: ``START:STOP:STEP`` of the frames.
        command: For the record.
        overwrite: Replace a run that is in the folder.
        resume: Continue the run that is there.
        listener: Called for every estimate, causal and refined.
        map_jobs: What takes the place of `run_in_processes` with so many workers.

    Raises:
        InputError: If the video cannot be split, or the folder holds another run.
        Tracking3dError: The frames finished until then are saved, for ``resume``.
    """
    video = LongVideo(
        str(source), config, folder, prompts, length, workers, selection, command, overwrite, resume
    )
    told, map_jobs = _once(listener), map_jobs or partial(run_in_processes, workers=workers)
    planned = plan_video(told, video)
    if isinstance(planned, SplitResult):
        return planned
    steps = steps_of(planned)
    estimates: list[Any] | None = None
    while True:
        try:
            wanted = next(steps) if estimates is None else steps.send(estimates)
        except StopIteration as stop:
            ended: SplitResult = stop.value
            return ended
        estimates = map_jobs(take_step, wanted, told=told)


def take_step(tell: Callable[[Any], None], step: Step) -> Any:
    """Do one step in this process."""
    return step.function(tell, step.argument)


def _once(listener: Listener) -> Listener:
    """Frames of two parts, and estimates that are only drawn again, are given once."""
    told: set[tuple[int, bool]] = set()

    def tell(frame: FrameRecord | SkippedFrame) -> None:
        key = frame.index, isinstance(frame, FrameRecord) and frame.refined
        if key not in told:
            told.add(key)
            listener(frame)

    return tell


Job = TypeVar("Job")
Result = TypeVar("Result")


def run_in_processes(
    function: Callable[[Reporter, Job], Result],
    jobs: Sequence[Job],
    workers: int,
    told: Callable[[Any], None] = lambda content: None,
) -> list[Result]:
    """Results of a module's function for each job, in the order of the jobs.

    One worker is this process. Ctrl-C and a failure stop the others; what they had finished is theirs to keep.

    Args:
        function: Called as ``function(tell, job)``.
        jobs: What can be pickled.
        workers: Processes at a time.
        told: Called in this process with everything that the functions report.

    Raises:
        Tracking3dError: The first that a job raised, or that its process crashed.
    """
    if workers <= 1 or len(jobs) <= 1:
        return [function(told, job) for job in jobs]

    def listener(event: Event) -> None:
        if isinstance(event, ProgressReport):
            told(event.content)
        elif isinstance(event, Ended):
            _raise(event)

    tasks = [Task(number, _call, (function, job)) for number, job in enumerate(jobs)]
    ended = map_tasks(ProcessEngine(min(workers, len(jobs))), tasks, listener=listener)
    return [ended[number].value for number in range(len(jobs))]


@dataclass(frozen=True)
class _Raised:
    """An error in a sentence, as the result of a process: engines report errors by their text only."""

    error: Tracking3dError


def _call(tell: Reporter, function: Callable[[Reporter, Any], Any], job: Any) -> Any:
    try:
        return function(tell, job)
    except Tracking3dError as error:
        return _Raised(error)


def _raise(event: Ended) -> None:
    if isinstance(event.value, _Raised):
        raise event.value.error
    if event.fault is None:
        return
    if event.fault.crashed:
        raise Tracking3dError(
            "A process that tracked a part of the video died without an error, as if memory ran out "
            f"({event.fault.reason.rstrip('.')}); continue with the same command and --resume."
        )
    raise Tracking3dError(f"A part of the video failed: {event.fault.reason}")


@dataclass(frozen=True, eq=False)
class Step:
    """One call in a worker."""

    # called as function(tell, argument); tell takes the record of every frame that is estimated
    function: Callable[[Any, Any], Any]
    argument: Any  # what it is called with; it can be pickled, as can what is returned
    label: str  # its name for the user
    frames: int = 0  # number of estimates it gives; 0 if unknown


Steps = Generator[list[Step], list[Any], SplitResult]
"""Gives steps that may be done side by side, and is sent what they returned, in their order."""


def steps_of(planned: PlannedVideo) -> Steps:
    """What is to be done for a video that is cut, until it is one run, or a run a part."""
    jobs, again = list(planned.jobs), list[int]()
    of, clock = len(jobs), time.monotonic()
    yield [
        Step(track_part, job, f"part {number} of {of}", _frames(job)) for number, job in enumerate(jobs, 1)
    ]
    while True:
        tracked = merge_step.Tracked(planned, tuple(jobs), tuple(again), time.monotonic() - clock)
        [found] = yield [Step(merge_step.merge_parts, tracked, "merging its parts")]
        if not isinstance(found, merge_step.Retrack):
            break
        jobs[found.number] = found.job
        again.append(found.number)
        yield [Step(track_part, found.job, f"part {found.number + 1} of {of} again", _frames(found.job))]
    if isinstance(found, merge_step.MergeFailure):
        whole = [replace(job, resume=True, first_pass_only=False) for job in jobs]
        yield [Step(track_part, job, f"end of part {number} of {of}") for number, job in enumerate(whole, 1)]
        return SplitResult(tuple(job.folder for job in jobs), of, found.reason)
    assert isinstance(found, merge_step.MergedSubmaps)
    clock = time.monotonic()
    yield [
        Step(refine_submap, revisit, f"refinement pass {number} of {of}", _frames(revisit))
        for number, revisit in enumerate(found.revisits, 1)
    ]
    seconds = {**found.seconds, "refinement_pass": time.monotonic() - clock}
    yield from steps_to_the_end(replace(found, seconds=seconds))
    return SplitResult((planned.video.folder,), of)


def steps_to_the_end(merged: merge_step.MergedSubmaps) -> Generator[list[Step], list[Any], None]:
    """The steps after all frames of a merged run have been refined."""
    precomputed, seconds = yield from _refine_in_parallel(merged)
    merged = replace(merged, seconds={**merged.seconds, **seconds})
    yield [Step(merge_step.finish_run, merge_step.FinishJob(merged, precomputed), "writing its results")]


def _refine_in_parallel(
    merged: merge_step.MergedSubmaps,
) -> Generator[list[Step], list[Any], tuple[PrecomputedRefinement, dict[str, float]]]:
    """The final refinement of the parts: its last steps, and the seconds of each."""
    revisits, of, clock = merged.revisits, len(merged.revisits), time.monotonic()
    refined = merged.seconds["refine"] + merged.seconds["refinement_pass"]
    [look] = yield [
        Step(merge_step.solve_together, merge_step.AdjustJob(revisits, refined), "global adjustment")
    ]
    settled = time.monotonic()
    placed = yield [
        Step(merge_step.adjust_poses, merge_step.PoseJob(job, look), f"poses {number} of {of}")
        for number, job in enumerate(revisits, 1)
    ]
    estimates = {record.index: record for part, _ in placed for record in part}
    retracked = {index: mask for _, part in placed for index, mask in part.items()}
    seconds = {"settle": settled - clock, "poses": time.monotonic() - settled}
    if not merged.planned.config.object.segments_again:
        return PrecomputedRefinement(look, estimates, {}, retracked), seconds
    clock = time.monotonic()
    masking = merge_step.MaskJob(revisits[0], estimates, look, retracked)
    [masks] = yield [Step(merge_step.collect_masks, masking, "collecting its masks")]
    decided = yield [
        Step(merge_step.decide_masks, replace(masking, job=job, masks=masks), f"masks {number} of {of}")
        for number, job in enumerate(revisits, 1)
    ]
    pictures = {index: mask for part in decided for index, mask in part.items()}
    masks_took = time.monotonic() - clock
    precomputed = PrecomputedRefinement(look, estimates, pictures, retracked, len(masks.kept))
    return precomputed, {**seconds, "masks": masks_took}


def _frames(job: PartJob | Revisit) -> int:
    start, stop, step = (int(number) for number in job.selection.split(":"))
    return len(range(start, stop, step))
