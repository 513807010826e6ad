"""Speeds of `tracking3d_bench.benchmark.track_speed` as tables, and the stages of every frame as a plot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.table import Table

from tracking3d.errors import OutputError
from tracking3d.runtime.stage_times import STAGES
from tracking3d_bench.benchmark.track_speed import PERCENTILES, TrackSpeed

_TALLEST = 5  # times the median frame that a plot shows; of a longer one it says how long it is


def speed_table(speeds: Sequence[TrackSpeed]) -> Table:
    """A column for each contender."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for speed in speeds:
        table.add_column(speed.name, justify="right")
    own = speeds[0].delays[0]
    rows: list[tuple[str, list[str]]] = [
        ("frames", [str(one.frames) for one in speeds]),
        ("frames a second, after the first", [_number(one.frames_per_second, 2) for one in speeds]),
        ("first estimate, s", [_number(one.first_answer, 1) for one in speeds]),
        ("whole command, s", [_number(one.wall, 1) for one in speeds]),
        ("  of all processors, s", [_number(one.processor, 1) for one in speeds]),
        *(
            (f"a frame, {share}th percentile, s", [_number(one.delays[place], 3) for one in speeds])
            for place, share in enumerate(PERCENTILES)
        ),
        ("  times that of the first column", [_number(one.delays[0] / own, 2) for one in speeds]),
        ("final refinement, a frame, s", [_number(one.refinement, 3) for one in speeds]),
        ("peak memory, MB", [_number(one.peak_memory, 0) for one in speeds]),
    ]
    for title, cells in rows:
        table.add_row(title, *cells)
    return table


def stage_table(speeds: Sequence[TrackSpeed]) -> Table:
    """Mean milliseconds a frame of every stage, and its share; one-time work counts too."""
    table = Table(box=None, pad_edge=False)
    table.add_column("mean of a frame, ms")
    for speed in speeds:
        table.add_column(speed.name, justify="right")
    for stage in STAGES:
        table.add_row(stage, *(_share(getattr(one.stages, stage), one.stages.whole) for one in speeds))
    table.add_row("together", *(f"{1e3 * one.stages.whole:.1f}     " for one in speeds))
    return table


def plot_stages(speeds: Sequence[TrackSpeed], path: Path) -> None:
    """A panel for each contender: the stages of every frame, one on top of the other.

    Raises:
        OutputError: If it cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 2.6 * len(speeds) + 0.6), layout="constrained")
    panels = figure.subplots(len(speeds), 1, squeeze=False)[:, 0]
    for panel, speed in zip(panels, speeds, strict=True):
        seconds = np.array(speed.over_time)
        below = np.zeros(len(seconds))
        for place, stage in enumerate(STAGES):
            panel.bar(np.arange(len(seconds)), seconds[:, place], 1.0, bottom=below, label=stage)
            below += seconds[:, place]
        top = min(float(below.max()), _TALLEST * float(np.median(below))) or 1.0
        panel.set_ylim(0, 1.15 * top)
        for frame in np.flatnonzero(below > top):
            panel.text(frame, 1.03 * top, f"{below[frame]:.1f} s", ha="center", fontsize="small")
        panel.set_xlim(-0.5, len(seconds) - 0.5)
        panel.set_ylabel("seconds")
        panel.set_title(speed.name, loc="left", fontsize="medium")
    panels[-1].set_xlabel("frame")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=len(STAGES))
    try:
        figure.savefig(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror or error}.") from error


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _share(seconds: float, whole: float) -> str:
    return f"{1e3 * seconds:.1f} {100 * seconds / whole if whole else 0:3.0f}%"
