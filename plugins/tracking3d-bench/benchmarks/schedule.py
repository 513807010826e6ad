"""Simulate many videos over many workers: in which order, cut or whole?

python benchmarks/schedule.py --workers 1000 --part 300
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from script import run


def schedule(
    videos: Annotated[int, typer.Option(min=1, max=1_000_000, help="How many.")] = 10_000,
    workers: Annotated[int, typer.Option(min=1, max=100_000, help="At a time.")] = 100,
    median: Annotated[float, typer.Option(min=0.1, help="Median length of a video in seconds.")] = 20.0,
    spread: Annotated[
        float, typer.Option(min=0, max=3, help="Standard deviation of the logarithm of the length.")
    ] = 1.2,
    work: Annotated[float, typer.Option(min=0.001, help="Seconds of work for a second of video.")] = 15.0,
    part: Annotated[
        float, typer.Option(min=0, help="Cut videos into parts of so many seconds; 0 cuts none.")
    ] = 120.0,
    slow: Annotated[
        float, typer.Option(min=0, max=1, help="Share of workers that take three times as long.")
    ] = 0.05,
    losses: Annotated[float, typer.Option(min=0, help="Times that a worker is lost in an hour.")] = 0.02,
    retries: Annotated[int, typer.Option(min=0, help="Times that a task is tried again.")] = 3,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume/--restart", help="Whether the work of lost workers is saved.", show_default=False
        ),
    ] = True,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random numbers.")] = 0,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw it into an .svg, .png or .pdf.")
    ] = None,
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
) -> None:
    """Simulate many videos of skewed length over many workers: order, retries, stragglers, cut or whole."""
    import json

    from fleet_report import as_json, compared, format_outcomes, plot_outcomes
    from fleet_simulation import Fleet, Splitting, skewed_lengths
    from tracking3d.cli.tables import print_table
    from tracking3d_bench.speed.plot import check_plot

    if plot:
        check_plot(plot)
    fleet = Fleet(workers, slow=slow, losses=losses, resumes=resume, retries=retries)
    splitting = Splitting(part * work) if part else None
    outcomes = compared(work * skewed_lengths(videos, median, spread, seed), fleet, splitting, seed)
    if plot:
        plot_outcomes(outcomes, workers, plot)
    if json_only:
        typer.echo(json.dumps({name: as_json(one) for name, one in outcomes.items()}))
    else:
        print_table(format_outcomes(outcomes))


if __name__ == "__main__":
    run(schedule)
