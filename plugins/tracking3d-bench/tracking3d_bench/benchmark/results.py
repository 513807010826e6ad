"""The scores of one variant on many sequences: saved as JSON, averaged, printed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from tracking3d.errors import InputError
from tracking3d.results.description import now, versions
from tracking3d.results.files import write_atomic, writing
from tracking3d.results.records import jsonable
from tracking3d.runtime.stage_times import STAGES
from tracking3d_bench.benchmark.fingerprint import code_fingerprint
from tracking3d_bench.benchmark.intervals import LEVEL, interval
from tracking3d_bench.benchmark.pool import JobOutcome
from tracking3d_bench.benchmark.sequences import Dataset
from tracking3d_bench.benchmark.variant import Variant

FORMAT = "tracking3d-results"

COLUMNS = {
    "iou_initial_mean": "IoU initial",
    "iou_mean": "IoU",
    "iou_gain_percent": "gain %",
    "share_own_masks": "own masks",
    "boundary_f_mean": "boundary F",
    "rotation_error_mean_deg": "rotation °",
    "share_under_5_deg": "under 5°",
    "rotation_error_return_deg": "on return °",
    "shape_f_score": "F-score",
    "points_average_jaccard": "AJ",
    "bop_ar": "AR",
    "frames_lost": "lost",
    "seconds_per_frame": "s/frame",
}
"""Measures that the table of a result set shows, and what it calls them."""


@dataclass(frozen=True)
class ResultSet:
    """What a variant is worth on a dataset.

    Attributes:
        label: What tables call it.
        dataset: Name of the dataset.
        scores: Measures by sequence; None for a sequence that failed.
        errors: Why sequences failed.
        about: Everything else that is saved: configuration, masks, versions, code, date.
        causal: Measures of the causal estimates, of the sequences that have refined ones too; `scores` are then those
            of the refined ones.
    """

    label: str
    dataset: str
    scores: Mapping[str, Mapping[str, Any] | None]
    errors: Mapping[str, str]
    about: Mapping[str, Any]
    causal: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def split(self) -> list[ResultSet]:
        """The causal estimates and the refined ones as two result sets; one if nothing was refined."""
        if not self.causal:
            return [self]
        causal = replace(
            self, label=f"{self.label}, causal", scores={**self.scores, **self.causal}, causal={}
        )
        return [causal, replace(self, label=f"{self.label}, refined", causal={})]

    def values(self, measure: str) -> dict[str, float]:
        """A measure by sequence, if it is known."""
        known = {name: (scores or {}).get(measure) for name, scores in self.scores.items()}
        return {name: float(value) for name, value in known.items() if value is not None}

    def mean(self, measure: str) -> float | None:
        """Mean of a measure over the sequences that have it; each sequence counts once."""
        values = list(self.values(measure).values())
        return float(np.mean(values)) if values else None

    def interval(self, measure: str) -> tuple[float, float] | None:
        """Bootstrap interval of `mean` over the sequences; None if fewer than two are known."""
        low, high = interval(np.array(list(self.values(measure).values())))
        return None if low is None or high is None else (low, high)


def collect(variant: Variant, dataset: Dataset, outcomes: Sequence[JobOutcome]) -> ResultSet:
    """The result set of one variant's outcomes."""
    about = {
        "suite_version": dataset.version,
        "masks": variant.masks,
        "config": variant.config.model_dump(mode="json"),
        "versions": versions(),
        "code": code_fingerprint(judges=False),
        "created": now(),
    }
    scores = {outcome.job.sequence: dict(outcome.scores) if outcome.scores else None for outcome in outcomes}
    causal = {name: one.pop("causal", None) for name, one in scores.items() if one is not None}
    return ResultSet(
        variant.label,
        dataset.name,
        scores,
        {outcome.job.sequence: outcome.error for outcome in outcomes if outcome.error},
        about,
        {name: one for name, one in causal.items() if one},
    )


def write_results(results: ResultSet, file: Path) -> None:
    """Write a result set as JSON.

    Raises:
        OutputError: If it cannot be written.
    """
    measures = sorted({measure for scores in results.scores.values() for measure in scores or {}})
    document = {
        "format": FORMAT,
        "label": results.label,
        "dataset": results.dataset,
        **results.about,
        "mean": {measure: results.mean(measure) for measure in measures},
        "interval": {measure: results.interval(measure) for measure in measures},
        "sequences": results.scores,
        "causal": results.causal,
        "errors": results.errors,
    }
    with writing(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(file, json.dumps(jsonable(document), indent=1).encode() + b"\n")


def read_results(file: Path) -> ResultSet:
    """Read what `write_results` wrote.

    Raises:
        InputError: If the file is not one of a result set.
    """
    try:
        document = json.loads(file.read_bytes())
        if document.pop("format") != FORMAT:
            raise ValueError("another format")
        document.pop("mean")
        document.pop("interval", None)
        label, name, scores, errors = (
            document.pop(one) for one in ("label", "dataset", "sequences", "errors")
        )
        causal = document.pop("causal", {})
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise InputError(
            f"{file} is not a result set ({error}); give a JSON file that `tracking3d evaluate suite` wrote."
        ) from error
    return ResultSet(label, name, scores, errors, document, causal)


def format_results(results: ResultSet) -> Table:
    """The main measures of every sequence, their means, and how far these would move with other sequences."""
    shown = {name: title for name, title in COLUMNS.items() if results.values(name)}
    table = Table(title=escape(f"{results.dataset}: {results.label}"), title_justify="left")
    table.add_column("sequence")
    for title in shown.values():
        table.add_column(title, justify="right")
    for name, scores in results.scores.items():
        table.add_row(escape(name), *(figure((scores or {}).get(measure), measure) for measure in shown))
    table.add_section()
    table.add_row("mean", *(figure(results.mean(measure), measure) for measure in shown), style="bold")
    between = {measure: results.interval(measure) for measure in shown}
    if any(between.values()):
        table.add_row(
            f"{LEVEL:.0%} interval",
            *("-" if ends is None else _between(ends, measure) for measure, ends in between.items()),
        )
    if (whole := results.mean("seconds_per_frame")) is not None:
        stages = {stage: results.mean(f"seconds_{stage}") for stage in STAGES}
        parts = ", ".join(f"{stage} {mean:.3f}" for stage, mean in stages.items() if mean is not None)
        table.caption, table.caption_justify = f"{whole:.3f} s a frame{parts and ': '}{parts}", "left"
    return table


def _between(ends: tuple[float, float], measure: str) -> str:
    return " to ".join(figure(end, measure) for end in ends)


def figure(value: float | None, measure: str) -> str:
    """A measure as tables show it."""
    if value is None:
        return "-"
    coarse = measure.endswith(("_deg", "_percent", "_mb", "frames_lost")) and not measure.startswith("share")
    return f"{value:.{1 if coarse else 3}f}"
