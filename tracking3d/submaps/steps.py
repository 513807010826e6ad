"""A long video as steps: calls of functions in workers, some of them in parallel, each list after the one before."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any

from tracking3d.pipeline.refinement_steps import PrecomputedRefinement
from tracking3d.submaps.job import SplitResult
from tracking3d.submaps.merge_step import Again, Ending, MergedSubmaps, Refused, Tracked, end, join
from tracking3d.submaps.parallel_refinement import (
    Placing,
    Settling,
    Weighing,
    adjust_poses,
    put_together,
    solve_together,
    weigh,
)
from tracking3d.submaps.plan_step import Begun
from tracking3d.submaps.submap_runs import PartJob, Revisit, refine_submap, track_part


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


def steps_of(begun: Begun) -> Steps:
    """What is to be done for a video that is cut, until it is one run, or a run a part."""
    jobs, again = list(begun.jobs), list[int]()
    of, clock = len(jobs), time.monotonic()
    yield [
        Step(track_part, job, f"part {number} of {of}", _frames(job)) for number, job in enumerate(jobs, 1)
    ]
    while True:
        taken = time.monotonic() - clock
        [found] = yield [Step(join, Tracked(begun, tuple(jobs), tuple(again), taken), "merging its parts")]
        if not isinstance(found, Again):
            break
        jobs[found.number] = found.job
        again.append(found.number)
        yield [Step(track_part, found.job, f"part {found.number + 1} of {of} again", _frames(found.job))]
    if isinstance(found, Refused):
        whole = [replace(job, resume=True, first_pass_only=False) for job in jobs]
        yield [Step(track_part, job, f"end of part {number} of {of}") for number, job in enumerate(whole, 1)]
        return SplitResult(tuple(job.folder for job in jobs), of, found.reason)
    assert isinstance(found, MergedSubmaps)
    clock = time.monotonic()
    looks = found.looks
    yield [
        Step(refine_submap, look, f"refinement pass {number} of {of}", _frames(look))
        for number, look in enumerate(looks, 1)
    ]
    seconds = {**found.seconds, "refinement_pass": time.monotonic() - clock}
    yield from steps_to_the_end(replace(found, seconds=seconds))
    return SplitResult((begun.video.folder,), of)


def steps_to_the_end(merged: MergedSubmaps) -> Generator[list[Step], list[Any], None]:
    """The steps after all frames of a merged run have been refined."""
    precomputed, seconds = yield from _refine_in_parallel(merged)
    merged = replace(merged, seconds={**merged.seconds, **seconds})
    yield [Step(end, Ending(merged, precomputed), "writing its results")]


def _refine_in_parallel(
    merged: MergedSubmaps,
) -> Generator[list[Step], list[Any], tuple[PrecomputedRefinement, dict[str, float]]]:
    """The final refinement of the parts: its last steps, and the seconds of each."""
    looks, of, clock = merged.looks, len(merged.looks), time.monotonic()
    refined = merged.seconds["refine"] + merged.seconds["refinement_pass"]
    [look] = yield [Step(solve_together, Settling(looks, refined), "global adjustment")]
    settled = time.monotonic()
    placed = yield [
        Step(adjust_poses, Placing(job, look), f"poses {number} of {of}")
        for number, job in enumerate(looks, 1)
    ]
    estimates = {record.index: record for part, _ in placed for record in part}
    retracked = {index: mask for _, part in placed for index, mask in part.items()}
    seconds = {"settle": settled - clock, "poses": time.monotonic() - settled}
    if not merged.begun.config.object.segments_again:
        return PrecomputedRefinement(look, estimates, {}, retracked), seconds
    clock = time.monotonic()
    weighing = Weighing(looks[0], estimates, look, retracked)
    [masks] = yield [Step(put_together, weighing, "collecting its masks")]
    decided = yield [
        Step(weigh, replace(weighing, job=job, masks=masks), f"masks {number} of {of}")
        for number, job in enumerate(looks, 1)
    ]
    pictures = {index: mask for part in decided for index, mask in part.items()}
    masks_took = time.monotonic() - clock
    precomputed = PrecomputedRefinement(look, estimates, pictures, retracked, len(masks.kept))
    return precomputed, {**seconds, "masks": masks_took}


def _frames(job: PartJob | Revisit) -> int:
    start, stop, step = (int(number) for number in job.selection.split(":"))
    return len(range(start, stop, step))
