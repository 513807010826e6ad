"""The table ``online``: the solvers `paper` and `online` side by side, by sequence, in one run on one machine.

A column is a solver with its features; if a run has refined estimates, its causal and its refined estimates are two.
Rotation errors are aligned and every frame counts, see `tracking3d_bench.evaluation.pose_scores`. A mean is over the
sequences for which every column has the figure, each counting once.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from tracking3d.errors import InputError
from tracking3d.results.files import write_atomic, writing
from tracking3d.runtime.stage_times import STAGES
from tracking3d_bench.benchmark.pool import Listener
from tracking3d_bench.benchmark.results import ResultSet, figure, write_results
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.suite import run_suite
from tracking3d_bench.benchmark.table import file_name
from tracking3d_bench.benchmark.tables import Plan, deep
from tracking3d_bench.benchmark.variant import Variant

NAME = "online"

MEASURES = {
    "iou_initial_mean": "IoU of the initial masks",
    "iou_mean": "IoU",
    "iou_gain_percent": "IoU gain %",
    "share_own_masks": "share of estimates that are not the initial mask",
    "share_worse_than_initial": "share of frames worse than the initial mask",
    "rotation_error_median_deg": "rotation error, median °",
    "rotation_error_mean_deg": "rotation error, mean °",
    "share_under_5_deg": "share of frames under 5°",
    "rotation_error_return_deg": "rotation error on return to the first view °",
    "share_lost": "share of frames lost",
    "shape_f_score": "F-score of the mesh at 2 %",
    "points_average_jaccard": "points, AJ",
    "bop_ar": "BOP AR",
    "confidence_calibration_error": "calibration error",
    "seconds_per_frame": "seconds a frame, mean",
    **{f"seconds_{stage}": f"of it {stage}" for stage in STAGES},
    "seconds_per_frame_median": "seconds a frame, median",
    "peak_memory_mb": "most memory, MB",
    "memory_growth_mb": "growth of memory, MB",
}
"""Measures of the table, and their names in it."""

_NOTE = (
    "Rotation errors are aligned by one rotation and all frames count: one called lost with the error of its pose, "
    "and as wrong for the share under 5°; one without a pose as 180°. Means are over the sequences for which every "
    "column has the figure. Seconds of refined estimates hold those of the causal ones."
)


@dataclass(frozen=True)
class SideBySide:
    """A filled table."""

    name: str  # its name
    caption: str  # what it shows, on which data, with which settings
    columns: tuple[str, ...]  # their names
    sequences: tuple[str, ...]  # their names
    figures: Mapping[str, Mapping[str, Mapping[str, float]]]  # by measure, column and sequence, if known
    notes: tuple[str, ...] = ()  # why something is missing

    def common(self, measure: str) -> list[str]:
        """The sequences for which every column has the figure."""
        return [
            name for name in self.sequences if all(name in self.figures[measure][one] for one in self.columns)
        ]

    def mean(self, measure: str, column: str) -> float | None:
        """Mean over the common sequences; None if there is none."""
        values = [self.figures[measure][column][name] for name in self.common(measure)]
        return float(np.mean(values)) if values else None

    def speed(self, column: str) -> float | None:
        """How many times as fast as `paper` with the same features; None without that or without times."""
        reference = ", ".join(["paper", *column.split(", ")[1:2]])
        if reference not in self.columns:
            return None
        own, other = (self.mean("seconds_per_frame", one) for one in (column, reference))
        return other / own if own and other else None

    @property
    def measures(self) -> list[str]:
        """Measures that are known at all."""
        return [measure for measure, columns in self.figures.items() if any(columns.values())]


def plan(base: Variant) -> Plan:
    """What is run: both solvers with RGB and deep features; `paper` as it is published, without what came later."""
    from tracking3d.pipeline.track import SOLVERS  # slow to import

    variants: Plan = {}
    own = base.config.solver.model_dump()
    for solver in ("paper", NAME):
        settings: dict[str, Any] = own if own["name"] == solver else {"name": solver}
        if solver == "paper":
            settings = {**settings, "final_refine": False, "tracker_feedback": False}
        for features in ("RGB", "S2DNet"):
            label = f"{solver}, {features}"
            if solver not in SOLVERS:
                variants[label] = f"there is no solver {solver}"
            elif features == "RGB":
                variants[label] = base.with_changes(label, features={"name": "rgb"}, solver=settings)
            else:
                variants[label] = deep(base, label, solver=settings)
    return variants


def fill(
    base: Variant,
    dataset: Dataset,
    out: Path,
    patterns: Sequence[str] = (),
    processes: int = 1,
    listener: Listener = lambda outcome: None,
    address: str | None = None,
) -> SideBySide:
    """Run what the table needs; every result set is written to ``out/results`` as well.

    Args:
        base: The settings that solvers and features change, and the initial masks.
        dataset: What to run on.
        out: Folder of the benchmark.
        patterns: Only solvers with features that match any of them, such as ``*RGB``; all if there is none.
        processes: Jobs at a time.
        listener: Called for every job.
        address: Address of a Ray cluster that runs them; this machine if None.

    Raises:
        InputError: If a pattern matches nothing.
    """
    everything = plan(base)
    for pattern in patterns:
        if not any(fnmatch(label, pattern) for label in everything):
            raise InputError(f"Table {NAME} has no row '{pattern}'; choose from: {'; '.join(everything)}.")
    chosen = {
        label: one
        for label, one in everything.items()
        if not patterns or any(fnmatch(label, pattern) for pattern in patterns)
    }
    variants = [one for one in chosen.values() if isinstance(one, Variant)]
    sets = run_suite(variants, dataset, out, processes, listener, address)
    masks = "" if base.masks == "tracker" else f"{file_name(Path(base.masks).name)}-"
    for one in sets:
        write_results(one, out / "results" / f"{NAME}-{file_name(one.label)}-{masks}{dataset.name}.json")
    notes = [f"{label}: {one}." for label, one in chosen.items() if isinstance(one, str)]
    return tabulate_results(sets, _caption(base, dataset), notes)


def tabulate_results(results: Sequence[ResultSet], caption: str, notes: Sequence[str] = ()) -> SideBySide:
    """Result sets of the same data as columns; one with refined estimates makes two."""
    columns = [half for one in results for half in one.split()]
    failed = [f"{one.label} failed on {', '.join(one.errors)}." for one in results if one.errors]
    sequences = dict.fromkeys(name for one in columns for name in one.scores)
    return SideBySide(
        NAME,
        caption,
        tuple(one.label for one in columns),
        tuple(sequences),
        {measure: {one.label: one.values(measure) for one in columns} for measure in MEASURES},
        (*notes, *failed),
    )


def _caption(base: Variant, dataset: Dataset) -> str:
    version = "" if dataset.version is None else f", version {dataset.version}"
    data = f"{dataset.name}{version} ({len(dataset.sequences)} sequences)"
    return f"The solvers on {data}. Settings: {base.label}. Initial masks: {base.masks}. {_NOTE}"


def _grids(table: SideBySide) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, header and rows of the table of means and of one for each measure."""
    means = []
    for measure in table.measures:
        figures = (figure(table.mean(measure, one), measure) for one in table.columns)
        means.append([MEASURES[measure], *figures, str(len(table.common(measure)))])
    speeds = [table.speed(one) for one in table.columns]
    if any(speeds):
        shown = ("-" if speed is None else f"{speed:.1f}" for speed in speeds)
        means.append(["times as fast as paper", *shown, str(len(table.common("seconds_per_frame")))])
    grids = [("Means", ["measure", *table.columns, "sequences"], means)]
    for measure in table.measures:
        of = table.figures[measure]
        rows = [
            [name, *(figure(of[one].get(name), measure) for one in table.columns)] for name in table.sequences
        ]
        rows.append(["mean", *(figure(table.mean(measure, one), measure) for one in table.columns)])
        grids.append((MEASURES[measure], ["sequence", *table.columns], rows))
    return grids


def to_markdown(table: SideBySide) -> str:
    """The table in Markdown, its caption above it."""
    parts = ["\n".join([table.caption, *table.notes])]
    for title, header, rows in _grids(table):
        rule = "|".join(["---"] + ["---:"] * (len(header) - 1))
        lines = (f"| {' | '.join(row)} |" for row in (header, *rows))
        head, *body = lines
        parts.append("\n".join([f"### {title}", "", head, f"|{rule}|", *body]))
    return "\n\n".join(parts) + "\n"


def to_csv(table: SideBySide) -> str:
    """The table as CSV with full precision: one figure a line."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["measure", "column", "sequence", "value"])
    for measure, columns in table.figures.items():
        for column, values in columns.items():
            writer.writerows([measure, column, name, value] for name, value in values.items())
    return text.getvalue()


def to_json(table: SideBySide) -> str:
    """The table as JSON with full precision, means included."""
    means = {measure: {one: table.mean(measure, one) for one in table.columns} for measure in table.measures}
    speeds = {one: table.speed(one) for one in table.columns}
    return json.dumps(asdict(table) | {"means": means, "times_as_fast_as_paper": speeds}, indent=1) + "\n"


def write_table(table: SideBySide, folder: Path) -> list[Path]:
    """Write a table in all three formats; returns the files.

    Raises:
        OutputError: If they cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    texts = {".md": to_markdown(table), ".csv": to_csv(table), ".json": to_json(table)}
    files = [folder / f"{table.name}{suffix}" for suffix in texts]
    for file, text in zip(files, texts.values(), strict=True):
        write_atomic(file, text.encode())
    return files


def format_table(table: SideBySide) -> list[Table]:
    """The tables for the terminal: means, then one for each measure; the caption is below the first."""
    printed = []
    for title, header, rows in _grids(table):
        one = Table(title=title, title_justify="left")
        for name in header:
            one.add_column(escape(name), justify="left" if name == header[0] else "right")
        for row in rows:
            one.add_row(*map(escape, row))
        printed.append(one)
    printed[0].caption = escape("\n".join([table.caption, *table.notes]))
    printed[0].caption_justify = "left"
    return printed
