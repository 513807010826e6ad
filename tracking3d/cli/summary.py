"""The closing table of a run."""

from __future__ import annotations

from pathlib import Path

from rich.markup import escape
from rich.table import Table

from tracking3d.cli.tables import format_value, print_table
from tracking3d.results import layout
from tracking3d.results.description import own_masks, time_per_frame
from tracking3d.results.run_reader import RunReader
from tracking3d.runtime.stage_times import STAGES
from tracking3d.ui.sentences import advise_networks, passes_in_words

_COLOURS = {"tracked": "green", "uncertain": "yellow", "lost": "red", "skipped": "red"}


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
            table.add_row(f"    in {failure['frames']} of them", escape(failure["reason"]))
    if refinement := run.get("refinement"):
        took = f"{refinement['frames']} frames in {format_value(refinement['seconds'])} s"
        table.add_row("final refinement", took if refinement["frames"] else escape(refinement["reason"]))
    own = own_masks(run)
    if own is not None:
        rest = "" if own == counts["frames"] else "; the others keep the initial mask"
        table.add_row("frames with an estimated mask", f"{own} of {counts['frames']}{rest if own else ''}")
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
    if took := passes_in_words(run):
        table.add_row("passes", took)
    if shape := run.get("shape"):
        table.add_row("shape", escape(str(shape)))
    if advice := advise_networks(reader.config.get("tracker", {}).get("name", "")):
        table.add_row("better masks", escape(advice))
    for note in run["notes"]:
        table.add_row("note", f"[yellow]{escape(note)}[/]")
    for what, names in layout.OUTPUTS.items():
        if files := [escape(str(folder / name)) for name in names if (folder / name).exists()]:
            table.add_row(what, "\n".join(files))
    print_table(table)
