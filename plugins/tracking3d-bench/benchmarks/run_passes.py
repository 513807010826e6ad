"""What each pass of finished runs took, beside one another over time: a table, and a plot.

python benchmarks/run_passes.py before=runs/before after=runs/after --plot passes.png
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from script import run


def run_passes(
    runs: Annotated[list[str], typer.Argument(metavar="[NAME=]RUN...", help="Finished run folders.")],
    plot: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Picture of the passes; needs matplotlib.")
    ] = None,
) -> None:
    """Print the seconds that each pass of some runs took, by `timings.passes` of their run.json."""
    from rich.table import Table

    from tracking3d.cli.tables import print_table
    from tracking3d.results.run_reader import RunReader
    from tracking3d_bench.speed.plot import check_plot

    if plot is not None:
        check_plot(plot)
    names = [one.rpartition("=")[0] or Path(one).name for one in runs]
    timings = [RunReader(Path(one.rpartition("=")[2])).description["timings"] for one in runs]
    passes: list[dict[str, float]] = [one["passes"] for one in timings]
    table = Table("pass", *names, box=None, pad_edge=False)
    for name in dict.fromkeys(name for one in passes for name in one):
        table.add_row(name, *(f"{one[name]:.1f}" if name in one else "" for one in passes))
    table.add_row("together", *(f"{sum(one.values()):.1f}" for one in passes))
    print_table(table)
    if plot is not None:
        _plot(names, passes, plot)


def _plot(names: list[str], passes: list[dict[str, float]], path: Path) -> None:
    """One bar for each run: its passes one after the other, each of one colour in all runs."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    from tracking3d_bench.speed.plot import save_figure

    figure = Figure(figsize=(10, 1.6 + 0.6 * len(names)), layout="constrained")
    axes = figure.subplots()
    for number, name in enumerate(dict.fromkeys(name for one in passes for name in one)):
        began = [sum(list(one.values())[: list(one).index(name)]) if name in one else 0 for one in passes]
        widths = [one.get(name, 0.0) for one in passes]
        axes.barh(names, widths, left=began, color=colormaps["tab20"](number % 20), label=name)
    axes.invert_yaxis()
    axes.set_xlabel("seconds from the start")
    figure.legend(loc="outside upper center", ncols=6, frameon=False)
    save_figure(figure, path)


if __name__ == "__main__":
    run(run_passes)
