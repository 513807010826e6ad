"""Two result sets side by side: is a change an improvement, or chance?

The sequences are the sample. Each contributes one difference, B less A; the interval is that of their mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.markup import escape
from rich.table import Table

from tracking3d.errors import InputError
from tracking3d_bench.benchmark.intervals import LEVEL, interval
from tracking3d_bench.benchmark.results import ResultSet, figure

MEASURES = {
    "iou_mean": ("IoU", True),
    "boundary_f_mean": ("boundary F", True),
    "rotation_error_mean_deg": ("rotation error, mean °", False),
    "share_under_5_deg": ("rotation under 5°", True),
    "points_average_jaccard": ("points, AJ", True),
    "bop_ar": ("BOP AR", True),
    "chamfer_percent": ("Chamfer distance, % of the diameter", False),
    "seconds_per_frame": ("seconds a frame", False),
}
"""Measures that are compared: what tables call them, and whether more is better."""


@dataclass(frozen=True)
class MeasureComparison:
    """One measure of two result sets on their common sequences.

    Attributes:
        measure: Its name in the scores.
        a, b: Means of the two.
        differences: B less A by sequence.
        low, high: Interval of the mean difference at `LEVEL`; None for fewer than two sequences.
    """

    measure: str
    a: float
    b: float
    differences: dict[str, float]
    low: float | None
    high: float | None

    @property
    def verdict(self) -> str:
        """What the interval says, in words."""
        if self.low is None or self.high is None:
            return "too few sequences"
        if self.low <= 0 <= self.high:
            return "no difference shown"
        return "B is better" if (self.low > 0) == MEASURES[self.measure][1] else "B is worse"


def compare(a: ResultSet, b: ResultSet, seed: int = 0) -> list[MeasureComparison]:
    """Compare two result sets by every measure that both have.

    Raises:
        InputError: If they have no scored sequence in common, or are of different data.
    """
    if a.dataset != b.dataset or a.about.get("suite_version") != b.about.get("suite_version"):
        raise InputError(
            f"The result sets are of different data ({_data(a)} and {_data(b)}); compare two of the same."
        )
    comparisons = []
    for measure in MEASURES:
        of_a, of_b = a.values(measure), b.values(measure)
        common = [name for name in of_a if name in of_b]
        if not common:
            continue
        differences = {name: of_b[name] - of_a[name] for name in common}
        low, high = interval(np.array(list(differences.values())), seed)
        mean_a, mean_b = (float(np.mean([values[name] for name in common])) for values in (of_a, of_b))
        comparisons.append(MeasureComparison(measure, mean_a, mean_b, differences, low, high))
    if not comparisons:
        raise InputError(
            "The two result sets have no scored sequence in common; compare two of the same data."
        )
    return comparisons


def format_comparison(comparisons: list[MeasureComparison], a: ResultSet, b: ResultSet) -> list[Table]:
    """A table of the means with their intervals, and one of the differences by sequence."""
    means = Table(title=escape(f"{a.dataset}: A = {a.label}, B = {b.label}"), title_justify="left")
    for title in ("measure", "A", "B", "B - A", f"{LEVEL:.0%} interval", "sequences", ""):
        means.add_column(title, justify="left" if title in ("measure", "") else "right")
    for one in comparisons:
        known = one.low is not None and one.high is not None
        between = f"{one.low:+.3f} to {one.high:+.3f}" if known else "-"
        cells = figure(one.a, one.measure), figure(one.b, one.measure), f"{one.b - one.a:+.3f}", between
        means.add_row(MEASURES[one.measure][0], *cells, str(len(one.differences)), one.verdict)
    paired = Table(title="B - A by sequence", title_justify="left")
    paired.add_column("sequence")
    for one in comparisons:
        paired.add_column(MEASURES[one.measure][0], justify="right")
    for name in a.scores:
        gains = tuple(
            f"{one.differences[name]:+.3f}" if name in one.differences else "-" for one in comparisons
        )
        paired.add_row(escape(name), *gains)
    return [means, paired]


def _data(results: ResultSet) -> str:
    version = results.about.get("suite_version")
    return results.dataset if version is None else f"{results.dataset} version {version}"
