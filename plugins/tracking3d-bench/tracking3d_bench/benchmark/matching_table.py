"""What ``tracking3d bench matching`` found out, as a table and as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from rich.markup import escape
from rich.table import Table

from tracking3d_bench.benchmark.feature_encoders import MeasuredEncoder
from tracking3d_bench.benchmark.matching import RADIUS, TOLERANCE, MatchingScores


def format_matching(measured: Mapping[str, MeasuredEncoder], channels: int | None = None) -> Table:
    """A row for each encoder.

    Args:
        measured: By label; times are compared with the first one's.
        channels: To how many channels features were reduced in the second test.
    """
    table = Table("encoder")
    titles = ["everywhere [%]", f"within {RADIUS:g} px [%]", "time [ms]", "ratio", "channels", "stride"]
    if channels is not None:
        titles[2:2] = [f"{channels} ch. everywhere [%]", f"{channels} ch. within {RADIUS:g} px [%]"]
    for title in titles:
        table.add_column(title, justify="right")
    ratios = time_ratios(measured)
    for label, one in measured.items():
        table.add_row(
            escape(label),
            *_shares(one.scores),
            *(_shares(one.reduced) if one.reduced else ()),
            f"{one.milliseconds:.1f}",
            f"{ratios[label]:.2f}",
            str(one.channels),
            str(one.stride),
        )
    return table


def matching_report(measured: Mapping[str, MeasuredEncoder], problem: Mapping[str, Any]) -> dict[str, Any]:
    """Everything that was measured, for JSON.

    Args:
        measured: By label; times are compared with the first one's.
        problem: What else the document is to hold.
    """
    ratios = time_ratios(measured)
    encoders = {label: {**asdict(one), "time_ratio": ratios[label]} for label, one in measured.items()}
    return {**problem, "tolerance_px": TOLERANCE, "radius_px": RADIUS, "encoders": encoders}


def time_ratios(measured: Mapping[str, MeasuredEncoder]) -> dict[str, float]:
    """Every encoder's time over the first one's, by label."""
    first = next(iter(measured.values())).milliseconds
    return {label: one.milliseconds / max(first, 1e-6) for label, one in measured.items()}


def _shares(scores: MatchingScores) -> tuple[str, str]:
    return f"{100 * scores.everywhere:.1f}", f"{100 * scores.nearby:.1f}"
