"""The results of a simulated fleet, as a table and a plot."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from fleet_simulation import ORDERS, Fleet, ScheduleOutcome, Splitting, simulate
from tracking3d.results.files import writing

NAMES = {"longest": "longest first", "first": "as they come", "random": "random"}
_COLOURS = {"longest": "#1b7837", "first": "#2166ac", "random": "#b2182b"}


def compared(
    work: Any, fleet: Fleet, splitting: Splitting | None, seed: int = 0
) -> dict[str, ScheduleOutcome]:
    """Every order with whole videos and, if ``splitting`` is given, with long ones cut; by a name in words."""
    outcomes = {}
    for order in ORDERS:
        outcomes[NAMES[order]] = simulate(work, fleet, order, None, seed)
        if splitting is not None:
            outcomes[f"{NAMES[order]}, split"] = simulate(work, fleet, order, splitting, seed)
    return outcomes


def format_outcomes(outcomes: Mapping[str, ScheduleOutcome]) -> Table:
    """A row for each."""
    table = Table("order", "hours", "busy", "last 1 % of videos", "done twice", "tasks", "given up")
    for name, one in outcomes.items():
        table.add_row(name, *row_of(one))
    return table


def markdown(outcomes: Mapping[str, ScheduleOutcome]) -> str:
    """The same as a table of Markdown."""
    head = "| order | hours | busy | last 1 % of videos | done twice | tasks | given up |\n"
    head += "|---|---|---|---|---|---|---|\n"
    return head + "".join(f"| {name} | {' | '.join(row_of(one))} |\n" for name, one in outcomes.items())


def row_of(outcome: ScheduleOutcome) -> list[str]:
    """An outcome in words."""
    return [
        f"{outcome.makespan / 3600:.1f}",
        f"{outcome.busy:.0%}",
        f"{outcome.tail:.0%} of the time",
        f"{outcome.wasted / 3600:.0f} h",
        str(outcome.attempts),
        str(outcome.given_up),
    ]


def as_json(outcome: ScheduleOutcome) -> dict[str, Any]:
    """An outcome as JSON has it."""
    names = ("makespan", "busy", "tail", "wasted", "attempts", "given_up")
    return {name: getattr(outcome, name) for name in names}


def plot_outcomes(outcomes: Mapping[str, ScheduleOutcome], workers: int, path: Path) -> None:
    """Draw how many workers work over time, and how many videos are done.

    Args:
        outcomes: From `compared`.
        workers: Number of workers of the fleet.
        path: What to write, see `tracking3d_bench.speed.plot.check_plot`.

    Raises:
        OutputError: If it cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 6.5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for name, one in outcomes.items():
        order = name.removesuffix(", split")
        key = next(key for key, value in NAMES.items() if value == order)
        style = {"color": _COLOURS[key], "linestyle": "--" if name != order else "-", "label": name}
        above.step(one.working[:, 0] / 3600, one.working[:, 1], where="post", linewidth=1, **style)
        done = np.sort(one.ends[np.isfinite(one.ends)]) / 3600
        below.plot(done, 100 * np.arange(1, len(done) + 1) / len(one.ends), linewidth=1.2, **style)
        below.plot(done[-1:], [100 * len(done) / len(one.ends)], "o", markersize=4, color=_COLOURS[key])
    above.set_ylabel(f"workers at work, of {workers}")
    above.set_ylim(0, 1.05 * workers)
    below.set_ylabel("videos done [%]")
    below.set_xlabel("hours")
    below.set_xlim(left=0)
    above.legend(loc="lower left", fontsize=8)
    for panel in (above, below):
        panel.grid(alpha=0.3)
    with writing(path):
        figure.savefig(path, dpi=130)
