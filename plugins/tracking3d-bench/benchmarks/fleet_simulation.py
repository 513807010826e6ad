"""A simulation of many videos over many workers: in which order, with what retries and stragglers, cut or whole.

Videos are tasks of known length in seconds of work on a usual worker. A worker that is free takes the next task by the
order; a part's end makes its video's join ready once all of its parts have ended. Workers are lost at random and
replaced; their tasks continue elsewhere from the last saved frame, or from the start. Everything is
drawn from one seed.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError

Order = Literal["longest", "first", "random"]
"""Longest video first, as they come, or by chance."""
ORDERS: tuple[Order, ...] = ("longest", "first", "random")
_LONGEST = 3600.0 * 4  # seconds of video


@dataclass(frozen=True)
class Fleet:
    """What works.

    Attributes:
        workers: How many at a time.
        slow: Share of them that are slow.
        slowness: How many times as long those take.
        losses: Times that a worker is lost in an hour of its work.
        replaced: Seconds until another one replaces it.
        resumes: Whether the work of a lost worker is saved.
        retries: Times that a task is tried again before it is given up.
    """

    workers: int = 100
    slow: float = 0.05
    slowness: float = 3.0
    losses: float = 0.02
    replaced: float = 60.0
    resumes: bool = True
    retries: int = 3


@dataclass(frozen=True)
class Splitting:
    """How long videos are cut, in shares of the work of the frames that it is about.

    Attributes:
        seconds: Work of a part.
        look_ahead: Work of the preview, before the parts.
        overlap: Work of the frames that two parts share.
        join: Work of merging by one worker, after the parts.
    """

    seconds: float
    look_ahead: float = 0.05
    overlap: float = 20.0
    join: float = 0.06


@dataclass(frozen=True, eq=False)
class ScheduleOutcome:
    """How it went.

    Attributes:
        makespan: Seconds until the last video was done.
        ends: ``(N,)`` when each video was; nan if it was given up.
        busy: Share of the workers' time, until the end, that was work.
        wasted: Seconds of work that were done twice.
        attempts: Tasks that were begun.
        given_up: Videos that were.
        working: ``(M, 2)`` times, and workers at work from then on.
    """

    makespan: float
    ends: NDArray[np.float64]
    busy: float
    wasted: float
    attempts: int
    given_up: int
    working: NDArray[np.float64]

    @property
    def tail(self) -> float:
        """Share of the time in which the last hundredth of the videos was done."""
        done = np.sort(self.ends[np.isfinite(self.ends)])
        return (
            float(1 - done[int(0.99 * (len(done) - 1))] / self.makespan)
            if len(done) and self.makespan
            else 0.0
        )


@dataclass(order=True)
class _Task:
    rank: tuple[float, ...]
    video: int = field(compare=False)
    work: float = field(compare=False)
    stage: int = field(compare=False)  # 0 a whole video or a preview, 1 a part, 2 a join
    tries: int = field(compare=False, default=0)


def skewed_lengths(
    count: int, median: float = 20.0, spread: float = 1.2, seed: int = 0
) -> NDArray[np.float64]:
    """Seconds ``(N,)`` of video: lognormal, most of them short and a few of hours."""
    drawn = np.random.default_rng(seed).lognormal(math.log(median), spread, count)
    return np.minimum(drawn, _LONGEST)


def simulate(
    work: Sequence[float] | NDArray[np.float64],
    fleet: Fleet,
    order: Order = "longest",
    splitting: Splitting | None = None,
    seed: int = 0,
) -> ScheduleOutcome:
    """Run all videos.

    Args:
        work: Seconds of each on a usual worker, in the order in which they come.
        fleet: What works.
        order: Which ready task is taken first.
        splitting: How those of at least two parts' work are cut; None cuts none.
        seed: Seed of the random numbers.

    Raises:
        InputError: If a number makes no sense.
    """
    _check(work, fleet, splitting)
    return _Simulation(
        np.asarray(work, np.float64), fleet, order, splitting, np.random.default_rng(seed)
    ).run()


class _Simulation:
    """One run of `simulate`."""

    def __init__(
        self,
        work: NDArray[np.float64],
        fleet: Fleet,
        order: Order,
        splitting: Splitting | None,
        random: np.random.Generator,
    ) -> None:
        self.work, self.fleet, self.splitting, self.random = work, fleet, splitting, random
        self.place = random.permutation(len(work)) if order == "random" else np.arange(len(work))
        self.longest = order == "longest"
        self.speed = np.ones(fleet.workers)
        self.speed[: round(fleet.slow * fleet.workers)] = 1 / fleet.slowness
        self.parts_left = np.zeros(len(work), int)
        self.ends = np.full(len(work), np.nan)
        self.lost = np.zeros(len(work), bool)
        self.ready: list[_Task] = []
        self.wasted = self.worked = 0.0
        self.attempts = 0
        self.changes: list[tuple[float, int]] = []

    def run(self) -> ScheduleOutcome:
        """To the end."""
        for video in range(len(self.work)):
            self.add(video, self._first_work(video), 0)
        free = list(self.random.permutation(self.fleet.workers))
        coming: list[tuple[float, int, int, _Task | None]] = []
        now, number = 0.0, 0
        while self.ready or coming:
            while self.ready and free:
                worker, task = int(free.pop()), heapq.heappop(self.ready)
                end, left = self._attempt(now, worker, task)
                self.changes += [(now, 1), (end, -1)]
                idle = end + (self.fleet.replaced if left else 0.0)
                number += 1
                heapq.heappush(coming, (end, number, -1 if left else worker, task if left is None else left))
                if left:
                    number += 1
                    heapq.heappush(coming, (idle, number, worker, None))
            now, _, worker, ended = heapq.heappop(coming)
            if worker >= 0:
                free.append(worker)
            if ended is not None:
                self._end(ended, now, again=worker < 0)
        last = float(np.nanmax(self.ends, initial=0.0))
        busy = self.worked / (self.fleet.workers * last) if last else 0.0
        return ScheduleOutcome(
            last, self.ends, busy, self.wasted, self.attempts, int(np.isnan(self.ends).sum()), self._working()
        )

    def add(self, video: int, work: float, stage: int, tries: int = 0) -> None:
        """A task is ready. Later tasks of a video come before videos that have not begun."""
        by = (-self.work[video], self.place[video]) if self.longest else (self.place[video],)
        heapq.heappush(self.ready, _Task((-stage if not self.longest else 0, *by), video, work, stage, tries))

    def _is_cut(self, video: int) -> bool:
        return self.splitting is not None and self.work[video] >= 2 * self.splitting.seconds

    def _first_work(self, video: int) -> float:
        share = self.splitting.look_ahead if self.splitting and self._is_cut(video) else 1.0
        return share * float(self.work[video])

    def _attempt(self, now: float, worker: int, task: _Task) -> tuple[float, _Task | None]:
        """When a worker ends with a task, and the work left if the worker is lost."""
        self.attempts += 1
        needed = task.work / self.speed[worker]
        rate = self.fleet.losses / 3600
        until = self.random.exponential(1 / rate) if rate > 0 else math.inf
        if until >= needed:
            self.worked += needed
            return now + needed, None
        done = until * self.speed[worker]
        self.worked += until
        if not self.fleet.resumes:
            self.wasted += until
            done = 0.0
        return now + until, _Task(task.rank, task.video, task.work - done, task.stage, task.tries + 1)

    def _end(self, task: _Task, now: float, again: bool) -> None:
        """What comes after a task: the same once more, or what waited for it."""
        video = task.video
        if again:
            if task.tries > self.fleet.retries:
                self.lost[video] = True
            elif not self.lost[video]:
                heapq.heappush(self.ready, task)
            return
        if self.lost[video]:
            return
        if task.stage == 2 or not self._is_cut(video):
            self.ends[video] = now
        elif task.stage == 0:
            self._add_parts(video)
        else:
            self.parts_left[video] -= 1
            if self.parts_left[video] == 0:
                assert self.splitting is not None
                self.add(video, self.splitting.join * float(self.work[video]), 2)

    def _add_parts(self, video: int) -> None:
        assert self.splitting is not None
        count = max(round(self.work[video] / self.splitting.seconds), 2)
        self.parts_left[video] = count
        for number in range(count):
            overlap = self.splitting.overlap if number + 1 < count else 0.0
            self.add(video, float(self.work[video]) * (1 - self.splitting.join) / count + overlap, 1)

    def _working(self) -> NDArray[np.float64]:
        if not self.changes:
            return np.zeros((1, 2))
        changes = np.array(sorted(self.changes), np.float64)
        return np.stack([changes[:, 0], np.cumsum(changes[:, 1])], 1)


def _check(work: Sequence[float] | NDArray[np.float64], fleet: Fleet, splitting: Splitting | None) -> None:
    values = np.asarray(work, np.float64)
    if values.ndim != 1 or not np.isfinite(values).all() or (values <= 0).any():
        raise InputError("The work of every video has to be a number of seconds above 0.")
    if (
        fleet.workers < 1
        or not 0 <= fleet.slow <= 1
        or fleet.slowness < 1
        or fleet.losses < 0
        or fleet.retries < 0
    ):
        raise InputError(
            "A fleet has one worker at least, a share of slow ones from 0 to 1 that take no less time than others, and "
            "no losses or retries below 0."
        )
    if splitting is not None and not (
        splitting.seconds > 0
        and splitting.overlap >= 0
        and splitting.look_ahead >= 0
        and 0 <= splitting.join < 1
    ):
        raise InputError(
            "The work of parts must be positive, and the shares of preview and merging from 0 to below 1."
        )
