"""How long the rest of a command will take, by what its stages have taken so far.

A plan says which stages there will be and what they cost on some machine. How much faster or slower this machine and
this video are is learnt from the stages that have gone by; the present one is judged by the pace of its last steps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from tracking3d.runtime.progress import StageProgress

LEAST = 1.0
"""Seconds that are left as long as there is work."""
_PACE = 20  # last steps of a stage that its pace is taken from
_TRUSTED = 2.0  # seconds of the plan that count as if they had gone by as planned
_OVERDUE = 0.25  # what takes longer than expected will take this much longer still


@dataclass(frozen=True)
class PlannedStage:
    """A stage that is to come."""

    name: str  # as `StageProgress.name` has it
    seconds: float  # what it costs, on the machine that the plan was made on
    # How many steps are planned; if the stage turns out to have more or fewer, it costs in proportion. None if the
    # cost does not depend on them.
    steps: int | None = None


class RemainingTime:
    """Estimates the remaining time from the plan and from what is reported.

    A stage inside another takes its time from that one. One that is interrupted goes on where it was.

    Args:
        plan: The stages in their order, each as often as it comes. Those that are reported but not planned are judged
            by their own pace; those that are planned and left out cost nothing.
    """

    def __init__(self, plan: Sequence[PlannedStage] = ()) -> None:
        self._plan = list(plan)
        self._spent: dict[int, float] = {}  # by place in the plan
        self._place = -1  # of the latest stage that is in the plan
        self._planned = False  # whether the present stage is
        self._now: StageProgress | None = None
        self._began = 0.0
        self._steps = deque[tuple[float, int]](maxlen=_PACE)

    def take(self, progress: StageProgress, now: float) -> None:
        """Take a report.

        Args:
            progress: The report.
            now: Its time in seconds, of any clock that only goes on.
        """
        if progress.inside and self._now is not None:
            return
        if self._now is None or progress.name != self._now.name:
            if self._planned:
                self._spent[self._place] = self._elapsed(now)
            self._began = now
            self._steps.clear()
            self._planned = self._find(progress)
        self._now = progress
        self._steps.append((now, progress.done))

    def seconds(self, now: float) -> float | None:
        """The seconds that are left, at least `LEAST`; None as long as nothing tells."""
        present = self._rest_of_stage(now)
        if present is None:
            return None
        pending = sum(stage.seconds for stage in self._plan[self._place + 1 :])
        return max(present + self._factor(now) * pending, LEAST)

    def _find(self, progress: StageProgress) -> bool:
        """Go to the stage in the plan, this one or a later one; False if there is none."""
        places = range(max(self._place, 0), len(self._plan))
        place = next((place for place in places if self._plan[place].name == progress.name), None)
        if place is None:
            return False
        self._place, stage = place, self._plan[place]
        if stage.steps and progress.total is not None:
            revised = stage.seconds * progress.total / stage.steps
            self._plan[place] = replace(stage, seconds=revised, steps=progress.total)
        return True

    def _elapsed(self, now: float) -> float:
        """Seconds of the present stage, those before it was interrupted too."""
        return now - self._began + (self._spent.get(self._place, 0.0) if self._planned else 0.0)

    def _rest_of_stage(self, now: float) -> float | None:
        """Seconds until the present stage ends; None if nothing tells."""
        if self._now is None:
            return None
        elapsed, total, done = self._elapsed(now), self._now.total, self._now.done
        planned = self._factor() * self._plan[self._place].seconds if self._planned else 0.0
        if not total or done == self._steps[0][1]:
            return max(planned - elapsed, _OVERDUE * elapsed) if self._planned else None
        pace, waiting = self._pace(), now - self._steps[-1][0]
        this_step = max(pace - waiting, _OVERDUE * waiting) if done < total else 0.0
        rest = pace * max(total - done - 1, 0) + this_step
        # The less of a stage is done, the less its pace says: its longest step may be still to come.
        return rest + (1 - done / total) * max(planned - elapsed - rest, 0.0)

    def _pace(self) -> float:
        """Seconds of a step, by the last ones; one that took longer than all others together does not count."""
        (first, done_first), (last, done) = self._steps[0], self._steps[-1]
        span, longest = last - first, max(after[0] - before[0] for before, after in pairwise(self._steps))
        once = done - done_first > 2 and longest > span / 2
        return (span - longest) / (done - done_first - 1) if once else span / (done - done_first)

    def _factor(self, now: float | None = None) -> float:
        """How many times longer than planned the stages take here; ``now``, the present one counts too."""
        planned = measured = _TRUSTED
        for place, spent in self._spent.items():
            if place != self._place or not self._planned:
                planned, measured = planned + self._plan[place].seconds, measured + spent
        if now is not None and self._planned and self._now is not None and self._now.total:
            planned += self._now.done / self._now.total * self._plan[self._place].seconds
            measured += self._elapsed(now)
        return measured / planned


def duration_in_words(seconds: float) -> str:
    """``40 s``, ``3 min 20 s`` or ``1 h 05 min``."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {seconds:02d} s" if minutes else f"{seconds} s"


def estimate_in_words(seconds: float) -> str:
    """An estimate of the remaining time, no more exact than it is: ``about 40 s left``."""
    step = 5 if seconds < 120 else 30
    return f"about {duration_in_words(step * math.ceil(seconds / step))} left"
