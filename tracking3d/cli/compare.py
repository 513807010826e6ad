"""``tracking3d compare``: what differs between runs on the same video."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracking3d.cli.options import AsJson, Debug, Quiet
from tracking3d.cli.options.general import OUTPUT

if TYPE_CHECKING:
    from tracking3d.ui.report.differences import RunComparison


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN RUN...", help="Run folders of the same video."),
    ],
    against: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN", help="Reference run that the others are compared with; default the first."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.html",
            help="Write an HTML page too, which shows the frames that differ most.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Print what differs between runs on the same video: settings, masks, poses, statuses and time."""
    import json

    from tracking3d.results.layout import check_run_folder

    for folder in (*runs, *([] if against is None else [against])):
        check_run_folder(folder)
    from tracking3d.cli.progress import load_with_progress, show_progress

    load_with_progress("tracking3d.ui.report.comparison", quiet)
    from tracking3d.ui.report.comparison import write_comparison
    from tracking3d.ui.report.differences import compare_runs

    with show_progress(quiet):
        comparison = compare_runs(runs, against)
        if out is not None:
            write_comparison(comparison, out)
    if as_json:
        typer.echo(json.dumps(comparison.as_json()))
        return
    for note in () if quiet else comparison.notes:
        typer.echo(note, err=True)
    _print(comparison)
    if out is not None:
        typer.echo(out)


def _print(comparison: RunComparison) -> None:
    from rich.markup import escape
    from rich.table import Table

    from tracking3d.cli.tables import format_value, print_table
    from tracking3d.runtime.stage_times import STAGES
    from tracking3d.ui.report.differences import run_figures

    names = [escape(name) for name in comparison.names]

    def table(title: str, rows: dict[str, list[Any]], columns: list[str]) -> None:
        drawn = Table("", *columns, title=title, title_justify="left")
        for name, values in rows.items():
            drawn.add_row(escape(name), *(escape(format_value(value)) for value in values))
        print_table(drawn)

    figures = [run_figures(run) for run in comparison.runs]
    stages = [one.pop("stages") or {} for one in figures]
    rows = {name.replace("_", " "): [one[name] for one in figures] for name in figures[0]}
    rows |= {f"  {stage}": [one.get(stage) for one in stages] for stage in STAGES}
    table("runs", rows, names)
    if comparison.settings:
        table("settings that differ", dict(comparison.settings), names)
    summaries = [one.summary for one in comparison.differences]
    apart = {_LABELS[key]: [one[key] for one in summaries] for key in summaries[0]}
    table(f"compared with {names[0]}", apart, names[1:])
    if len(names) > 2:
        table("every pair: mean mask IoU, median rotation", _every_two(comparison), names)
    worst = {
        f"frame {index}": [_at(one, index) for one in comparison.differences] for index in comparison.worst
    }
    if worst:
        table("frames that differ most", worst, names[1:])


def _every_two(comparison: RunComparison) -> dict[str, list[Any]]:
    iou, turn = comparison.iou_between, comparison.rotation_between
    return {
        name: [
            None
            if row == column
            else f"{iou[row, column]:.3f}, {turn[row, column]:.1f}°".replace("nan°", "-").replace("nan", "-")
            for column in range(len(comparison.names))
        ]
        for row, name in enumerate(comparison.names)
    }


def _at(one: Any, index: int) -> str | None:
    for place in (one.indices == index).nonzero()[0]:
        return f"IoU {one.iou[place]:.3f}, rotation {one.rotation[place]:.1f}°".replace("nan°", "-").replace(
            "nan", "-"
        )
    return None


_LABELS = {
    "frames": "common frames",
    "iou_mean": "mask IoU, mean",
    "iou_least": "mask IoU, minimum",
    "rotation_median_deg": "rotation, median (degrees)",
    "rotation_greatest_deg": "rotation, maximum",
    "translation_median_percent": "translation, median (% of distance)",
    "translation_greatest_percent": "translation, maximum",
    "scale": "scale, relative to the first",
}
