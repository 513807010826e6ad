"""A long video as steps: calls of functions in workers, some of them side by side, each list after the one before."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any

from tracking3d.last_passes import PrecomputedRefinement
from tracking3d.splitting.beginning import Begun
from tracking3d.splitting.ending import Again, Ending, Joined, Refused, Tracked, end, join
from tracking3d.splitting.last_looks import Placing, Settling, Weighing, place, put_together, settle, weigh
from tracking3d.splitting.long_video import SplitResult
from tracking3d.splitting.part_runs import PartJob, Revisit, look_again, track_part


@dataclass(frozen=True, eq=False)
class Step:
    """One call in a worker.

    Attributes:
        function: Called as ``function(tell, argument)``; ``tell`` takes the record of every frame that is answered.
        argument: What it is called with; it can be pickled, as can what is returned.
        label: What it is called, for who looks on.
        frames: How many answers it gives; 0 where that is not known.
    """

    function: Callable[[Any, Any], Any]
    argument: Any
    label: str
    frames: int = 0


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
        [found] = yield [Step(join, Tracked(begun, tuple(jobs), tuple(again), taken), "joining its parts")]
        if not isinstance(found, Again):
            break
        jobs[found.number] = found.job
        again.append(found.number)
        yield [Step(track_part, found.job, f"part {found.number + 1} of {of} again", _frames(found.job))]
    if isinstance(found, Refused):
        whole = [replace(job, resume=True, first_pass_only=False) for job in jobs]
        yield [Step(track_part, job, f"end of part {number} of {of}") for number, job in enumerate(whole, 1)]
        return SplitResult(tuple(job.folder for job in jobs), of, found.reason)
    assert isinstance(found, Joined)
    clock = time.monotonic()
    looks = found.looks
    yield [
        Step(look_again, look, f"second look {number} of {of}", _frames(look))
        for number, look in enumerate(looks, 1)
    ]
    seconds = {**found.seconds, "second_look": time.monotonic() - clock}
    yield from steps_to_the_end(replace(found, seconds=seconds))
    return SplitResult((begun.video.folder,), of)


def steps_to_the_end(joined: Joined) -> Generator[list[Step], list[Any], None]:
    """What is left to be done when all frames of a joined run were looked at again."""
    precomputed, seconds = yield from _last_looks(joined)
    joined = replace(joined, seconds={**joined.seconds, **seconds})
    yield [Step(end, Ending(joined, precomputed), "its end")]


def _last_looks(
    joined: Joined,
) -> Generator[list[Step], list[Any], tuple[PrecomputedRefinement, dict[str, float]]]:
    """What becomes of the frames, and the seconds of each step."""
    looks, of, clock = joined.looks, len(joined.looks), time.monotonic()
    refined = joined.seconds["refine"] + joined.seconds["second_look"]
    [look] = yield [Step(settle, Settling(looks, refined), "what its frames say together")]
    settled = time.monotonic()
    placed = yield [
        Step(place, Placing(job, look), f"poses {number} of {of}") for number, job in enumerate(looks, 1)
    ]
    estimates = {record.index: record for part in placed for record in part}
    seconds = {"settle": settled - clock, "poses": time.monotonic() - settled}
    if not joined.begun.config.object.evidence:
        return PrecomputedRefinement(look, estimates, {}), seconds
    clock = time.monotonic()
    weighing = Weighing(looks[0], estimates, look)
    [masks] = yield [Step(put_together, weighing, "what its masks say together")]
    decided = yield [
        Step(weigh, replace(weighing, job=job, masks=masks), f"masks {number} of {of}")
        for number, job in enumerate(looks, 1)
    ]
    pictures = {index: mask for part in decided for index, mask in part.items()}
    masks_took = time.monotonic() - clock
    return PrecomputedRefinement(look, estimates, pictures), {**seconds, "masks": masks_took}


def _frames(job: PartJob | Revisit) -> int:
    start, stop, step = (int(number) for number in job.selection.split(":"))
    return len(range(start, stop, step))
