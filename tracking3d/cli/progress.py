"""Progress of a command on the standard error: its stage, how far that is, and the remaining time.

On a terminal it is a line that moves as long as the command works, also within a step that takes long; in a log it is
a line every ten seconds. Importing this module does not load torch, so that the line is there before.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn
from rich.table import Column

from tracking3d.errors import InputError
from tracking3d.runtime.memory import collection_deferred
from tracking3d.runtime.progress import StageProgress, listen_to_progress

if TYPE_CHECKING:
    from tracking3d.frames import SkippedFrame
    from tracking3d.results.records import FrameRecord
    from tracking3d.ui.picker.server import PageProgress

_EVERY = 10.0
"""Seconds between lines of a log."""
_STARTING = "starting"
_COLOURS = {"tracked": "green", "uncertain": "yellow", "lost": "red"}


class ProgressDisplay:
    """What is shown of a command's progress; the base shows nothing."""

    def __init__(self) -> None:
        self._remaining = RemainingTime()
        self._began = time.monotonic()
        self._progress = StageProgress(_STARTING)
        self._part = self._detail = ""
        self._share = 0.0
        self._frame: int | None = None

    def expect(self, plan: Sequence[PlannedStage]) -> None:
        """Estimate the remaining time by these stages from here on."""
        self._remaining = RemainingTime(plan)

    def take(self, progress: StageProgress) -> None:
        """Show a stage and how far it is."""
        self._part = f": {progress.name}" if progress.inside else ""
        if not progress.inside:
            self._detail = self._detail if progress.name == self._progress.name else ""
            self._progress = progress
        self._remaining.take(progress, time.monotonic())

    def show_frame(self, frame: FrameRecord | SkippedFrame) -> None:
        """Show what came of a frame: a listener for `tracking3d.pipeline.record`."""
        self._detail, self._frame = _describe(frame), frame.index

    def progress(self) -> PageProgress:
        """The same for a page."""
        from tracking3d.ui.picker.server import PageProgress

        now = time.monotonic()
        sentence = f"{self._stage}, {self._time(now)}"
        return PageProgress(True, sentence, share=self._measure(now), frame=self._frame)

    def _measure(self, now: float) -> float | None:
        """The share that is done; None as long as nothing tells."""
        left = self._remaining.seconds(now)
        if left is not None:  # what takes longer than expected holds the bar, and does not move it back
            self._share = max(self._share, (now - self._began) / (now - self._began + left))
        return None if left is None else self._share

    @property
    def _stage(self) -> str:
        """The stage with its count, and the part of a step that takes long."""
        now = self._progress
        count = f" {now.done}/{now.total}" if now.total else f" {now.done}" if now.done else ""
        return f"{now.name}{count}{self._part}"

    def _time(self, now: float) -> str:
        """The remaining time, or the time that has gone by as long as the other is unknown."""
        left = self._remaining.seconds(now)
        return duration_in_words(now - self._began) if left is None else estimate_in_words(left)


class _Bar(Progress):
    """Asks for the present state whenever it is drawn, so that the time goes on within a step."""

    before_drawing: Callable[[], None] = staticmethod(lambda: None)

    def get_renderables(self) -> Iterable[RenderableType]:
        """What is drawn."""
        self.before_drawing()
        yield from super().get_renderables()


class _Line(ProgressDisplay):
    """A line on a terminal, drawn by a thread of its own ten times a second."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._bar = _Bar(
            SpinnerColumn(),
            TextColumn("{task.description}", table_column=Column(no_wrap=True)),
            BarColumn(bar_width=16),
            TextColumn("{task.fields[time]}", table_column=Column(no_wrap=True)),
            TextColumn("{task.fields[detail]}", table_column=Column(no_wrap=True, overflow="ellipsis")),
            console=console,
            transient=True,
        )
        self._bar.before_drawing = self._refresh
        self._task = self._bar.add_task(_STARTING, total=None, time="", detail="")

    def __enter__(self) -> None:
        self._bar.start()

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def _refresh(self) -> None:
        now = time.monotonic()
        share = self._measure(now)
        self._bar.update(
            self._task,
            description=self._stage,
            total=None if share is None else 1.0,
            completed=self._share,
            time=self._time(now),
            detail=self._detail,
        )


class _Log(ProgressDisplay):
    """A line every ten seconds, printed by a thread of its own."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console, self._over = console, threading.Event()
        self._thread = threading.Thread(target=self._print_regularly, daemon=True, name="tracking3d-progress")

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *error: object) -> None:
        self._over.set()
        self._thread.join()

    def _print_regularly(self) -> None:
        while not self._over.wait(_EVERY):
            parts = filter(None, (self._stage, self._detail, self._time(time.monotonic())))
            self._console.print(", ".join(parts), highlight=False, soft_wrap=True)


@contextmanager
def show_progress(quiet: bool, plan: Sequence[PlannedStage] = ()) -> Iterator[ProgressDisplay]:
    """Show on the standard error which stage the command is in, as long as the block runs.

    Args:
        quiet: Show nothing.
        plan: The stages that will come, if they are known by now; see `ProgressDisplay.expect`.

    Yields:
        The display.
    """
    if quiet:
        yield ProgressDisplay()
        return
    console = Console(stderr=True)
    display = _Line(console) if console.is_terminal else _Log(console)
    display.expect(plan)
    with display, listen_to_progress(display.take):
        yield display


def load_with_progress(module: str, quiet: bool, kernels: bool = False) -> None:
    """Import a module that takes seconds to load, so that imports of it afterwards take no time.

    Args:
        module: Its full name.
        quiet: Show nothing meanwhile.
        kernels: Whether compiled kernels will be needed: those that are missing are compiled.
    """
    _refuse_little_address_space()
    with show_progress(quiet), collection_deferred():
        import_module(module)
        if kernels:
            import_module("tracking3d.runtime.kernels_ahead").compile_missing()


_LEAST_ADDRESS_SPACE = 2.5
"""Gigabytes; measured. From 1.7 to 2.0 libraries ended the process of a small clip themselves, without a word."""


def _refuse_little_address_space() -> None:
    with suppress(ImportError):  # Windows has no such limit
        import resource

        allowed = resource.getrlimit(resource.RLIMIT_AS)[0]
        if allowed != resource.RLIM_INFINITY and allowed < _LEAST_ADDRESS_SPACE * 1e9:
            raise InputError(
                f"The process may use {allowed / 1e9:.1f} GB of address space (ulimit -v), which is not enough memory; "
                f"allow {_LEAST_ADDRESS_SPACE} GB or more."
            )


def _describe(frame: FrameRecord | SkippedFrame) -> str:
    """Frame, status, IoU with the initial mask, and time, in the markup of rich."""
    from tracking3d.cli.tables import format_value
    from tracking3d.frames import SkippedFrame

    if isinstance(frame, SkippedFrame):
        if frame.repeats is not None:
            return f"frame {frame.index} {frame.reason}"
        return f"[red]frame {frame.index} skipped[/]"
    colour, iou = _COLOURS[frame.status], format_value(frame.iou_initial)
    return f"frame {frame.index} [{colour}]{frame.status}[/] IoU {iou} {frame.seconds:.2f} s"


# How long the rest of a command will take, by what its stages have taken so far.
#
# A plan says which stages there will be and what they cost on some machine. How much faster or slower this machine and
# this video are is learnt from the stages that have gone by; the present one is judged by the pace of its last steps.

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


# The stages of commands and what they cost, for the estimate of the remaining time.
#
# Seconds were measured on two cores; what counts is how the stages compare.

_FIRST_TEXTURE = [PlannedStage("texture", 0.5), PlannedStage("writing the model", 0.5)]
_TEXTURE = [PlannedStage("texture", 1.5), PlannedStage("writing the model", 0.5)]
_SHAPE = [
    PlannedStage("carving the hull", 2.4),
    PlannedStage("matching depths", 0.8),
    PlannedStage("fusing depths", 2.7),
    PlannedStage("extracting the surface", 0.25),
    PlannedStage("fitting outlines", 0.65),
    PlannedStage("testing the shape", 0.25),
    PlannedStage("unwrapping the surface", 1.0),
]
_READING = 0.006
"""Seconds of a frame."""


def plan_run(
    config: Mapping[str, Any], frames: int | None, objects: int = 1, report: bool = True, kept: int = 0
) -> list[PlannedStage]:
    """The stages of tracking.

    Args:
        config: The configuration, as ``run.json`` holds it.
        frames: Number of frames; None, as of a camera, plans nothing.
        objects: Number of objects.
        report: Whether a report is written.
        kept: How many frames keep their estimates, because they come before what was corrected.
    """
    if frames is None:
        return []
    made = frames - kept
    count, refines = made * objects, config.get("solver", {}).get("final_refine")
    first = 0.07 * kept if kept else 10.0  # the mask tracker sees them again, or the first map is made
    # Around the frames that are made again, others that stand are looked at, too.
    poses, evidence, masks = (0.33, 0.2, 0.24) if kept else (0.11, 0.025, 0.09)
    plan = [PlannedStage("tracking", first * objects + 0.33 * count, frames)]
    if refines:
        plan += objects * [PlannedStage("refining the map", 2.0)]
        plan += [PlannedStage("refining frames", poses * count, made)]
        plan += objects * _plan_landmarks(frames) if made > kept else []
        plan += [PlannedStage("collecting masks", evidence * count, made)]
        plan += [PlannedStage("refining masks", masks * count, made)]
        plan += objects * _FIRST_TEXTURE
    shape = config.get("object", {}).get("shape")
    if shape == "fine" or (shape == "auto" and refines):
        plan += objects * plan_shape(frames)
    return plan + objects * plan_report(frames) if report else plan


def plan_shape(frames: int) -> list[PlannedStage]:
    """The stages of a new shape from so many frames."""
    return [PlannedStage("reading frames", _READING * frames, frames), *_SHAPE, *_TEXTURE]


def plan_texture(frames: int) -> list[PlannedStage]:
    """The stages of a new texture."""
    return [PlannedStage("reading frames", _READING * frames, frames), *_TEXTURE]


def plan_report(frames: int) -> list[PlannedStage]:
    """The stages of a report."""
    return [PlannedStage("report", 0.01 * frames, frames), PlannedStage("turntable", 0.8)]


def plan_points(frames: int) -> list[PlannedStage]:
    """The stages of following points."""
    reading = PlannedStage("reading frames", 0.05 * frames, frames)
    return [reading, *_plan_landmarks(frames), PlannedStage("following points", 0.05 * frames)]


def _plan_landmarks(frames: int) -> list[PlannedStage]:
    return [PlannedStage("refining poses", 0.2 * frames), PlannedStage("fitting outlines", 2.5)]
