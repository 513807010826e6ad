"""Progress of a command on the standard error: its stage, how far that is, and the remaining time.

On a terminal it is a line that moves as long as the command works, also within a step that takes long; in a log it is
a line every ten seconds. Importing this module does not load torch, so that the line is there before.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import import_module
from typing import TYPE_CHECKING

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn
from rich.table import Column

from tracking3d.cli.remaining_time import PlannedStage, RemainingTime, duration_in_words, estimate_in_words
from tracking3d.errors import InputError
from tracking3d.runtime.garbage_collection import collection_deferred
from tracking3d.runtime.progress import StageProgress, listen_to_progress

if TYPE_CHECKING:
    from tracking3d.frames import SkippedFrame
    from tracking3d.picker.server import PageProgress
    from tracking3d.results.records import FrameRecord

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
        from tracking3d.picker.server import PageProgress

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
        return f"[red]frame {frame.index} skipped[/]"
    colour, iou = _COLOURS[frame.status], format_value(frame.iou_initial)
    return f"frame {frame.index} [{colour}]{frame.status}[/] IoU {iou} {frame.seconds:.2f} s"
