"""What a run shows while it goes on, and at its end."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from tracking3d.cli.tables import format_value, print_table
from tracking3d.frames import SkippedFrame
from tracking3d.recording import Listener
from tracking3d.results import layout
from tracking3d.results.description import own_masks, time_per_frame
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.stages import STAGES

_EVERY = 10.0  # seconds between lines of a log
_COLOURS = {"tracked": "green", "uncertain": "yellow", "lost": "red", "skipped": "red"}


@contextmanager
def progress(count: int | None, quiet: bool, objects: int = 1) -> Iterator[Listener]:
    """A progress bar on the standard error: frame, status, IoU against the initial mask, speed, time left.

    It begins again where the frames come a second time, in the final refinement. Where the standard error is no
    terminal, but a log, it is a line every now and then.

    Args:
        count: Number of frames, where known.
        quiet: Show nothing.
        objects: How many are tracked; the bar counts the frames of each.

    Yields:
        The listener to tell of every frame.
    """
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _silent if quiet else _logged(console, count and count * objects)
        return
    bar = Progress(
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[frame]}"),
        TimeRemainingColumn(compact=True),
        console=console,
        disable=quiet,
        transient=True,
    )
    tasks = [bar.add_task("", total=count and count * objects, frame="first frame")]

    def listener(frame: FrameRecord | SkippedFrame) -> None:
        again = isinstance(frame, FrameRecord) and frame.refined
        if again and len(tasks) == 1:
            bar.update(tasks[0], visible=False)
            tasks.append(bar.add_task("", total=bar.tasks[0].completed, frame="once more"))
        bar.update(tasks[-1], advance=1, frame=_line(frame))

    with bar:
        yield listener


def _silent(frame: FrameRecord | SkippedFrame) -> None:
    pass


def _logged(console: Console, count: int | None) -> Listener:
    """Prints how far it is, at most once in `_EVERY` seconds and not before these are over."""
    last, done = time.monotonic(), {False: 0, True: 0}

    def listener(frame: FrameRecord | SkippedFrame) -> None:
        nonlocal last
        again = isinstance(frame, FrameRecord) and frame.refined
        done[again] += 1
        if time.monotonic() - last >= _EVERY:
            last = time.monotonic()
            total = done[False] if again else count
            console.print(
                f"{done[again]}{f' of {total}' if total else ''}: {_line(frame)}",
                highlight=False,
                soft_wrap=True,
            )

    return listener


def print_summary(folder: Path) -> None:
    """Print the closing table of the run in ``folder``."""
    reader = RunReader(folder)
    run = reader.description
    counts, (whole, stages) = run["counts"], time_per_frame(run)
    table = Table(
        title=f"{escape(str(folder))} ({reader.state_in_words})", show_header=False, title_justify="left"
    )
    if choice := run.get("tracker_choice"):
        table.add_row("mask tracker", escape(str(choice)))
    table.add_row("frames", str(counts["frames"]))
    for status in ("tracked", "uncertain", "lost", "skipped"):
        if counts[status] or status == "tracked":
            table.add_row(f"  {status}", f"[{_COLOURS[status]}]{counts[status]}[/]")
    if counts["failed"]:
        table.add_row("  with a plug-in failure", f"[red]{counts['failed']}[/]")
        for failure in run["failures"]:
            table.add_row(f"    {failure['frames']} of them", escape(failure["reason"]))
    if refinement := run.get("refinement"):
        took = f"{refinement['frames']} frames in {format_value(refinement['seconds'])} s"
        table.add_row("final refinement", took if refinement["frames"] else escape(refinement["reason"]))
    own = own_masks(run)
    if own is not None:
        handed_back = counts["frames"] - own
        told = f" of {counts['frames']}" + (
            "; the others are the initial masks" if own and handed_back else ""
        )
        table.add_row("masks of its own", f"{own}{told if own else told + ': all are the initial masks'}")
    if own is None or own:
        table.add_row(
            "mean IoU with the initial masks"
            if own is None
            else "  mean IoU of these with the initial masks",
            format_value(run["iou_initial_mean"] if own is None else run["iou_initial_mean_own"]),
        )
    table.add_row("seconds per frame", format_value(whole))
    for stage in STAGES if stages else ():
        table.add_row(f"  {stage}", format_value(getattr(stages, stage)))
    if shape := run.get("shape"):
        table.add_row("shape", escape(str(shape)))
    for note in run["notes"]:
        table.add_row("note", f"[yellow]{escape(note)}[/]")
    for what, names in _OUTPUTS.items():
        if files := [escape(str(folder / name)) for name in names if (folder / name).exists()]:
            table.add_row(what, "\n".join(files))
    print_table(table)


_OUTPUTS = {
    "poses": (layout.FRAMES,),
    "masks": (layout.MASKS,),
    "mesh": (layout.OBJ, layout.GLB),
    "video": (layout.OVERLAY,),
    "contact sheet": (layout.CONTACT_SHEET,),
    "report": (layout.REPORT,),
}


def _line(frame: FrameRecord | SkippedFrame) -> str:
    if isinstance(frame, SkippedFrame):
        return f"[{_COLOURS['skipped']}]frame {frame.index} skipped[/]"
    once_more = "once more: " if frame.refined else ""
    return (
        f"{once_more}frame {frame.index} [{_COLOURS[frame.status]}]{frame.status}[/] "
        f"IoU {format_value(frame.iou_initial)} {frame.seconds:.2f} s"
    )
