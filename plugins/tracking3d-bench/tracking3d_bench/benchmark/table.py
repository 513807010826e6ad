"""Filling a table of the paper, and writing it as Markdown, CSV, JSON and an image."""

from __future__ import annotations

import csv
import io
import json
import random
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table as Printed

from tracking3d.results.files import write_atomic, writing
from tracking3d_bench.benchmark.pool import Listener
from tracking3d_bench.benchmark.results import ResultSet, write_results
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.suite import run_suite
from tracking3d_bench.benchmark.tables import Table, TableRow
from tracking3d_bench.benchmark.variant import Variant

SEED = 0
COLUMNS = (
    "row",
    "paper",
    "paper gain %",
    "here",
    "gain %",
    "rotation °",
    "s/frame",
    "sequences",
    "improved",
    "note",
)


@dataclass(frozen=True)
class Line:
    """A filled row: the paper's figures and those measured here; None if there is none."""

    label: str  # the row's name
    paper: float | None = None  # the paper's measure
    paper_gain_percent: float | None = None  # the paper's gain over the initial masks
    here: float | None = None  # the same measure here
    gain_percent: float | None = None  # gain of the mean IoU over that of the initial masks here
    rotation_error_mean_deg: float | None = None  # mean rotation error, if the poses are known
    seconds_per_frame: float | None = None  # mean wall time
    sequences: int = 0  # number of sequences that the figures here are the mean of
    # number of those whose mean IoU is above that of their initial masks; None if none is compared
    improved: int | None = None
    note: str = ""  # why something is missing


@dataclass(frozen=True)
class Filled:
    """A table with both columns."""

    name: str  # its name
    caption: str  # what it shows, on which data, with which settings
    lines: tuple[Line, ...]  # its rows


def fill(
    table: Table,
    base: Variant,
    dataset: Dataset,
    out: Path,
    processes: int = 1,
    initial: Mapping[str, Path] | None = None,
    listener: Listener = lambda outcome: None,
    address: str | None = None,
) -> Filled:
    """Make the runs of a table and compare them with the paper's figures; every result set is written to
    ``out/results``.

    Args:
        table: Which one.
        base: The settings that its rows change.
        dataset: The real dataset, or a synthetic suite.
        out: Folder of the benchmark.
        processes: Jobs at a time.
        initial: Folders of initial masks by tracker, in lower case.
        listener: Called for every job.
        address: Address of a Ray cluster that runs them; this machine if None.
    """
    plan = table.plan(base, dataset.synthetic, initial or {})
    chosen = _choose_sequences(table, dataset)
    used = {row.plan for row in table.rows}
    variants = {
        name: variant for name, variant in plan.items() if isinstance(variant, Variant) and name in used
    }
    sets = run_suite(list(variants.values()), chosen, out, processes, listener, address)
    results = dict(zip(variants, sets, strict=True))
    for name, result in results.items():
        write_results(result, out / "results" / f"{table.name}-{file_name(name)}-{chosen.name}.json")
    lines = tuple(line for row in table.rows for line in _lines(row, table, plan, results))
    return Filled(table.name, _caption(table, base, chosen), lines)


def file_name(label: str) -> str:
    """A label as a part of a file's name."""
    return "_".join("".join(sign if sign.isalnum() else " " for sign in label.lower()).split())


def _choose_sequences(table: Table, dataset: Dataset) -> Dataset:
    if dataset.synthetic:
        return dataset.only(list(table.sequences))
    if not 0 < table.sample < len(dataset.sequences):
        return dataset
    return dataset.only(sorted(random.Random(SEED).sample(dataset.sequences, table.sample)))


def _lines(
    row: TableRow, table: Table, plan: Mapping[str, Variant | str], results: Mapping[str, ResultSet]
) -> list[Line]:
    """A row's line; two, causal and refined, if its run has both estimates and the row shows estimates."""
    result = results.get(row.plan)
    if result is None or row.initial or not result.causal:
        return [_line(row, table, plan, results)]
    causal, refined = (_line(row, table, plan, {row.plan: one}) for one in result.split())
    return [
        replace(causal, label=f"{row.label}, causal"),
        replace(refined, label=f"{row.label}, refined", paper=None, paper_gain_percent=None),
    ]


def _line(
    row: TableRow, table: Table, plan: Mapping[str, Variant | str], results: Mapping[str, ResultSet]
) -> Line:
    paper = row.paper.value if row.paper else None
    line = Line(row.label, paper, row.paper.gain if row.paper else None)
    if not row.plan:
        return line
    if row.plan not in results:
        return replace(line, note=str(plan[row.plan]))
    result = results[row.plan]
    measure = "iou_initial_mean" if row.initial else table.measure
    line = replace(
        line,
        here=result.mean(measure),
        sequences=len(result.values(measure)),
        note=f"failed: {', '.join(result.errors)}" if result.errors else "",
    )
    if row.initial:
        return line
    start = result.mean("iou_initial_mean") if table.measure == "iou_mean" else None
    return replace(
        line,
        gain_percent=100 * (line.here / start - 1) if line.here is not None and start else None,
        improved=None
        if start is None
        else sum(gain > 0 for gain in result.values("iou_gain_percent").values()),
        rotation_error_mean_deg=result.mean("rotation_error_mean_deg"),
        seconds_per_frame=result.mean("seconds_per_frame"),
    )


def _caption(table: Table, base: Variant, dataset: Dataset) -> str:
    version = "" if dataset.version is None else f", version {dataset.version}"
    data = (
        f"Column 'here' is measured on the synthetic suite {dataset.name}{version} "
        f"({len(dataset.sequences)} sequences), as the real data are absent: an initial tracker is the true masks "
        "degraded to the mean IoU that the paper gives for it. The columns are therefore not on the same data."
        if dataset.synthetic
        else f"Column 'here' is measured on {dataset.name} ({len(dataset.sequences)} sequences)."
    )
    paper = f"{table.title} ({table.source} of Rozumnyi et al., ICCV 2023)."
    return " ".join(part for part in (paper, data, f"Settings: {base.label}.", table.note) if part)


def cells(line: Line) -> tuple[str, ...]:
    """A line as texts, in the order of `COLUMNS`."""
    return (
        line.label,
        _number(line.paper, 4),
        _number(line.paper_gain_percent, 1, sign=True),
        _number(line.here, 4),
        _number(line.gain_percent, 1, sign=True),
        _number(line.rotation_error_mean_deg, 1),
        _number(line.seconds_per_frame, 2),
        str(line.sequences or ""),
        "" if line.improved is None else str(line.improved),
        line.note,
    )


def _number(value: float | None, digits: int, sign: bool = False) -> str:
    return "" if value is None else f"{value:{'+' if sign else ''}.{digits}f}"


def to_markdown(filled: Filled) -> str:
    """The table in Markdown, its caption above it."""
    rule = "|".join("---" if title in ("row", "note") else "---:" for title in COLUMNS)
    rows = (" | ".join(cells(line)) for line in filled.lines)
    head = f"{filled.caption}\n\n| {' | '.join(COLUMNS)} |\n|{rule}|\n"
    return head + "".join(f"| {row} |\n" for row in rows)


def to_csv(filled: Filled) -> str:
    """The table as CSV with full precision."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(Line.__dataclass_fields__), lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(line) for line in filled.lines)
    return text.getvalue()


def to_json(filled: Filled) -> str:
    """The table as JSON with full precision."""
    return json.dumps(asdict(filled), indent=1) + "\n"


def write_table(filled: Filled, folder: Path) -> list[Path]:
    """Write a table in all three formats; returns the files.

    Raises:
        OutputError: If they cannot be written.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    texts: dict[str, Any] = {".md": to_markdown(filled), ".csv": to_csv(filled), ".json": to_json(filled)}
    files = [folder / f"{filled.name}{suffix}" for suffix in texts]
    for file, text in zip(files, texts.values(), strict=True):
        write_atomic(file, text.encode())
    return files


def format_table(filled: Filled) -> Printed:
    """The table for the terminal."""
    printed = Printed(caption=escape(filled.caption), caption_justify="left")
    for title in COLUMNS:
        printed.add_column(title, justify="left" if title in ("row", "note") else "right")
    for line in filled.lines:
        printed.add_row(*(escape(cell) for cell in cells(line)))
    return printed
