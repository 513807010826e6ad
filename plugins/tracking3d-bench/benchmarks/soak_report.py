"""The results of a long run, as a table and a plot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from looped_run import SETTLED, SoakReport
from tracking3d.errors import OutputError


def format_soak(report: SoakReport) -> Table:
    """The report for the terminal."""
    table = Table("", f"at frame {SETTLED}", "at the end", "least", "most", "", box=None, pad_edge=False)
    for name, label, digits in (
        ("memory", "memory, MB", 1),
        ("descriptors", "open files", 1),
        ("seconds", "seconds a frame", 4),
    ):
        if trend := report.trends.get(name):
            numbers = (trend.start, trend.end, trend.least, trend.most)
            verdict = "flat" if trend.flat else "[red]grows[/]"
            table.add_row(label, *(f"{number:.{digits}f}" for number in numbers), verdict)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(report.counts.items()))
    table.caption = f"{report.frames} frames ({counts}); the object left and returned {report.rounds} times"
    table.caption_justify = "left"
    return table


def plot_soak(report: SoakReport, path: Path) -> None:
    """Plot the measures over the frames.

    Raises:
        OutputError: If the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 8), layout="constrained")
    index = [sample.index for sample in report.samples]
    panels: Any = figure.subplots(3, 1, sharex=True)
    for panel, name, label in zip(
        panels,
        ("memory", "descriptors", "seconds"),
        ("memory, MB", "open files", "seconds a frame"),
        strict=True,
    ):
        values = [getattr(sample, name) for sample in report.samples]
        panel.set_ylabel(label)
        panel.plot(index, values, linewidth=0.5, color="grey")
        width = min(100, len(values))
        means = np.convolve(np.asarray(values, float), np.ones(width) / width, "valid")
        panel.plot(index[width - 1 :], means, linewidth=1.5, label=f"mean of {width} frames")
        if name == "seconds":
            panel.set_ylim(0, 1.3 * float(np.percentile(values, 99)))
        panel.axvline(SETTLED, linestyle="--", linewidth=1, color="grey")
        panel.legend(loc="lower right", fontsize="small")
        panel.grid(alpha=0.3)
    panels[-1].set_xlabel("frame")
    try:
        figure.savefig(path, dpi=120)
    except OSError as error:
        raise OutputError(f"--plot {path} cannot be written: {error.strerror}") from error
