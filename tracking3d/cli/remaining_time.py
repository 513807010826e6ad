"""How long the rest of a command will take, by what its stages have taken so far.

A plan says which stages there will be and what they cost on some machine. How much faster or slower this machine and
this video are is learnt from the stages that have gone by; the present one is judged by the pace of its last steps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from tracking3d.runtime.progress import StageProgress

LEAST = 1.0
"""Seconds that are left as long as there is work."""
_PACE = 20  # last steps of a stage that its pace is taken from
_TRUSTED = 2.0  # seconds of the plan that count as if they had gone by as planned
_OVERDUE = 0.25  # what takes longer than expected will take this much longer still


@dataclass(frozen=True)
class PlannedStage:
    """A stage that is to come.

    Attributes:
        name: As `StageProgress.name` has it.
        seconds: What it costs, on the machine that the plan was made on.
    """

    name: str
    seconds: float


class RemainingTime:
    """Estimates the remaining time from the plan and from what is reported.

    Args:
        plan: The stages in their order; those that several objects go through one after the other appear once, with
            the cost of all. Stages that are reported but not planned are judged by their own pace.
    """

    def __init__(self, plan: Sequence[PlannedStage] = ()) -> None:
        self._plan = plan
        self._spent: dict[int, float] = {}  # by place in the plan
        self._place = -1  # of the latest stage that is in the plan
        self._planned: PlannedStage | None = None  # the present stage, if it is
        self._now: StageProgress | None = None
        self._began = 0.0
        self._steps = deque[tuple[float, int]](maxlen=_PACE)

    def take(self, progress: StageProgress, now: float) -> None:
        """Take a report.

        Args:
            progress: The report.
            now: Its time in seconds, of any clock that only goes on.
        """
        if self._now is None or progress.name != self._now.name:
            if self._planned is not None:
                self._spent[self._place] = self._spent.get(self._place, 0.0) + now - self._began
            self._began = now
            self._steps.clear()
            self._planned = self._find(progress.name)
        self._now = progress
        self._steps.append((now, progress.done))

    def seconds(self, now: float) -> float | None:
        """The seconds that are left, at least `LEAST`; None as long as nothing tells."""
        present = self._rest_of_stage(now)
        if present is None:
            return None
        pending = sum(stage.seconds for stage in self._plan[self._place + 1 :])
        return max(present + self._factor(now) * pending, LEAST)

    def _find(self, name: str) -> PlannedStage | None:
        """The next stage of that name in the plan, or an earlier one that a further object goes through."""
        places = [place for place, stage in enumerate(self._plan) if stage.name == name]
        if not places:
            return None
        self._place = next((place for place in places if place > self._place), places[0])
        return self._plan[self._place]

    def _rest_of_stage(self, now: float) -> float | None:
        """Seconds until the present stage ends; None if nothing tells."""
        if self._now is None:
            return None
        elapsed, total = now - self._began, self._now.total
        (first, done_first), (last, done) = self._steps[0], self._steps[-1]
        if total and done > done_first:
            pace, waiting = (last - first) / (done - done_first), now - last
            this_step = max(pace - waiting, _OVERDUE * waiting) if done < total else 0.0
            return pace * max(total - done - 1, 0) + this_step
        if self._planned is None:
            return None
        return max(self._factor(now) * self._planned.seconds - elapsed, _OVERDUE * elapsed)

    def _factor(self, now: float) -> float:
        """How many times longer than planned the stages take here."""
        planned = measured = _TRUSTED
        for place, spent in self._spent.items():
            planned, measured = planned + self._plan[place].seconds, measured + spent
        if self._planned is not None and self._now is not None and self._now.total:
            share = self._now.done / self._now.total
            planned, measured = planned + share * self._planned.seconds, measured + now - self._began
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
