"""What ``tracking3d bench points`` found out, as a table and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from rich.table import Table

from tracking3d_bench.benchmark.intervals import interval
from tracking3d_bench.benchmark.point_runs import METHODS, MeasuredRun

_MEASURES = ("delta", "occlusion", "jaccard", "returned")


def point_report(runs: Sequence[MeasuredRun]) -> dict[str, Any]:
    """Means over the sequences with their intervals, by masks, estimates and method, and every run by itself."""
    groups = []
    for masks, refined in dict.fromkeys((run.masks, run.refined) for run in runs):
        chosen = [run for run in runs if (run.masks, run.refined) == (masks, refined)]
        methods = {
            name: {
                measure: _mean([getattr(run.rows[name], measure) for run in chosen]) for measure in _MEASURES
            }
            for name in METHODS
            if name in chosen[0].rows
        }
        groups.append(
            {
                "masks": masks,
                "answers": "refined" if refined else "causal",
                "sequences": len(chosen),
                "methods": methods,
                "inside_two_sigma": _mean([run.inside for run in chosen]),
            }
        )
    each = [
        {
            "sequence": run.sequence,
            "masks": run.masks,
            "answers": "refined" if run.refined else "causal",
            "methods": {name: asdict(row) for name, row in run.rows.items()},
            "inside_two_sigma": run.inside,
            "seconds_landmarks": run.seconds_landmarks,
        }
        for run in runs
    ]
    return {"groups": groups, "runs": each}


def format_points(report: dict[str, Any]) -> Table:
    """A row for each method of each group, with intervals of 95 %."""
    table = Table("masks", "answers", "method")
    for title in ("delta_avg", "OA", "AJ", "after hidden", "inside 2 sigma"):
        table.add_column(title, justify="right")
    for group in report["groups"]:
        for name, row in group["methods"].items():
            inside = group["inside_two_sigma"] if name == METHODS[0] else None
            cells = [_cell(row[measure]) for measure in _MEASURES]
            table.add_row(group["masks"], group["answers"], name, *cells, _cell(inside))
        table.add_section()
    return table


def _mean(values: Sequence[float | None]) -> dict[str, float | None] | None:
    known = np.array([value for value in values if value is not None])
    if not len(known):
        return None
    low, high = interval(known)
    return {"mean": float(known.mean()), "low": low, "high": high}


def _cell(value: dict[str, float | None] | None) -> str:
    if value is None:
        return "-"
    if value["low"] is None:
        return f"{value['mean']:.3f}"
    return f"{value['mean']:.3f} ({value['low']:.3f} to {value['high']:.3f})"
