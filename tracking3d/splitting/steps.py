"""A long video as steps: calls of functions in workers, some of them side by side, each list after the one before."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any

from tracking3d.splitting.beginning import Begun
from tracking3d.splitting.ending import Again, Joined, Refused, Tracked, end, join
from tracking3d.splitting.long_video import Ended
from tracking3d.splitting.part_runs import PartJob, SecondLook, look_again, track_part


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


Steps = Generator[list[Step], list[Any], Ended]
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
        return Ended(tuple(job.folder for job in jobs), of, found.reason)
    assert isinstance(found, Joined)
    clock = time.monotonic()
    looks = found.looks
    yield [
        Step(look_again, look, f"second look {number} of {of}", _frames(look))
        for number, look in enumerate(looks, 1)
    ]
    seconds = {**found.seconds, "second_look": time.monotonic() - clock}
    yield [Step(end, replace(found, seconds=seconds), "its end")]
    return Ended((begun.video.folder,), of)


def _frames(job: PartJob | SecondLook) -> int:
    start, stop, step = (int(number) for number in job.selection.split(":"))
    return len(range(start, stop, step))
