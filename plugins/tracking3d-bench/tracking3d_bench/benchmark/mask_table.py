"""What `tracking3d_bench.benchmark.mask_trackers` measured, as a table and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from rich.markup import escape
from rich.table import Table

from tracking3d.results.description import versions
from tracking3d.results.records import jsonable
from tracking3d_bench.benchmark.mask_trackers import TrackerMeasurement, overall
from tracking3d_bench.benchmark.sequences import Dataset

COLUMNS = {
    "iou_mean": ("IoU", 3),
    "boundary_f_mean": ("boundary F", 3),
    "share_under_half": ("under .5", 2),
    "milliseconds": ("ms/frame", 0),
    "auc_50": ("AUC .5", 2),
    "auc_70": ("AUC .7", 2),
    "frames_scored": ("frames", 0),
}
"""Measures that the table shows: what it calls them, and digits after the point."""


def format_masks(results: Sequence[TrackerMeasurement], dataset: Dataset) -> Table:
    """A row for every tracker on every sequence, and one for every tracker's mean."""
    table = Table("tracker", "sequence", title=escape(f"{dataset.name}: mask trackers"), title_justify="left")
    for title, _ in COLUMNS.values():
        table.add_column(title, justify="right")
    with_errors = any(one.error for one in results)
    if with_errors:
        table.add_column("note")
    for tracker, figures in overall(results).items():
        for one in results:
            if one.tracker == tracker:
                note = (escape(one.error),) if with_errors else ()
                table.add_row(escape(tracker), escape(one.sequence), *_cells(one.figures()), *note)
        table.add_row(escape(tracker), "mean", *_cells(figures), style="bold")
        table.add_section()
    return table


def report(results: Sequence[TrackerMeasurement], dataset: Dataset, start: str) -> dict[str, Any]:
    """Everything that was measured, frame by frame too, for JSON."""
    document = {
        "dataset": dataset.name,
        "suite_version": dataset.version,
        "start": start,
        "versions": versions(),
        "mean": overall(results),
        "results": [{**one.figures(), **asdict(one)} for one in results],
    }
    return jsonable(document)


def _cells(figures: dict[str, float | int | None]) -> tuple[str, ...]:
    return tuple(
        "-" if (value := figures[name]) is None else f"{value:.{digits}f}"
        for name, (_, digits) in COLUMNS.items()
    )
