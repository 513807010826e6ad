"""What a run shows while it goes on, and at its end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from tracking3d.cli.tables import print_table, shown
from tracking3d.frames import SkippedFrame
from tracking3d.recording import Listener
from tracking3d.results import layout
from tracking3d.results.description import own_masks, time_per_frame
from tracking3d.results.records import FrameRecord
from tracking3d.results.run_reader import RunReader
from tracking3d.stages import STAGES

_COLOURS = {"tracked": "green", "uncertain": "yellow", "lost": "red", "skipped": "red"}


@contextmanager
def progress(count: int | None, quiet: bool, objects: int = 1) -> Iterator[Listener]:
    """A progress bar on the standard error: frame, status, IoU against the initial mask, speed, time left.

    It begins again where the frames come a second time, in the final refinement.

    Args:
        count: Number of frames, where known.
        quiet: Show nothing, as where the standard error is no terminal.
        objects: How many are tracked; the bar counts the frames of each.

    Yields:
        The listener to tell of every frame.
    """
    console = Console(stderr=True)
    bar = Progress(
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TextColumn("{task.fields[frame]}"),
        TimeRemainingColumn(compact=True),
        console=console,
        disable=quiet or not console.is_terminal,
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
        took = f"{refinement['frames']} frames in {shown(refinement['seconds'])} s"
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
            shown(run["iou_initial_mean"] if own is None else run["iou_initial_mean_own"]),
        )
    table.add_row("seconds per frame", shown(whole))
    for stage in STAGES if stages else ():
        table.add_row(f"  {stage}", shown(getattr(stages, stage)))
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
        f"IoU {shown(frame.iou_initial)} {frame.seconds:.2f} s"
    )
