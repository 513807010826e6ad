"""A table of the paper as bars: its figures beside those measured here. Needs matplotlib, which is optional."""

from __future__ import annotations

from pathlib import Path

from tracking3d_bench.benchmark.table import Filled, Line
from tracking3d_bench.speed.plot import save_figure

_WIDTH = 0.4


def plot_table(filled: Filled, path: Path) -> None:
    """Draw a table into an .svg, .png or .pdf file.

    Raises:
        OutputError: If it cannot be written.
    """
    # The figure draws on no screen: pyplot, which would choose one, is not involved.
    from matplotlib.figure import Figure

    lines = [line for line in filled.lines if line.paper is not None or line.here is not None]
    figure = Figure(figsize=(1.5 + 0.8 * len(lines), 4.5), layout="constrained")
    axes = figure.subplots()
    for offset, label, values in (
        (-_WIDTH / 2, "paper", [line.paper for line in lines]),
        (_WIDTH / 2, "here", [line.here for line in lines]),
    ):
        known = {place + offset: value for place, value in enumerate(values) if value is not None}
        if known:
            bars = axes.bar(list(known), list(known.values()), width=_WIDTH, label=label)
            axes.bar_label(bars, fmt="%.3f", fontsize="x-small", rotation=90, padding=3)
    axes.set_xticks(
        range(len(lines)), [line.label for line in lines], rotation=35, ha="right", fontsize="small"
    )
    axes.set_ylim(*_limits(lines))
    axes.set_ylabel("average recall" if filled.name == "bop" else "IoU")
    axes.grid(axis="y", alpha=0.3)
    axes.legend(loc="upper left", ncols=2, frameon=False)
    save_figure(figure, path)


def _limits(lines: list[Line]) -> tuple[float, float]:
    """Ends of the axis: near the least and the largest value, so that differences are seen, with room for labels."""
    values = [value for line in lines for value in (line.paper, line.here) if value is not None]
    low = max(0.0, int(20 * min(values) - 1) / 20)
    return low, low + 1.4 * (max(values) - low)
