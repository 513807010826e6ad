"""``tracking3d bench cost``: what many hours of video cost, by the figures of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug


def cost(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Finished run folders.")],
    hours: Annotated[float, typer.Option(help="Of video.")] = 1000.0,
    fps: Annotated[float, typer.Option(help="Frames a second of the videos.")] = 30.0,
    minutes: Annotated[float, typer.Option(help="Mean length of a video.")] = 1.0,
    processors: Annotated[int, typer.Option(min=1, help="Of a machine.")] = 16,
    memory: Annotated[float, typer.Option(min=0.1, help="Of a machine, in 10^9 bytes.")] = 64.0,
    disk: Annotated[float, typer.Option(min=0.001, help="What it writes, in 10^6 bytes a second.")] = 200.0,
    network: Annotated[
        float, typer.Option(min=0.001, help="What videos come by, in 10^6 bytes a second.")
    ] = 125.0,
    video: Annotated[
        Path | None, typer.Option(metavar="PATH", help="The video of the first run, for what is read.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """What many hours of video cost by the measured figures of runs: time, disk, memory, and what binds."""
    import json
    from dataclasses import asdict

    from tracking3d.benchmark.video_costs import Machine, cost_of, figures_of, format_costs
    from tracking3d.benchmark.video_costs import as_json as told
    from tracking3d.cli.tables import print_table

    machine = Machine(processors, 1e9 * memory, 1e6 * disk, 1e6 * network)
    figures = {str(run): figures_of(run, video if n == 0 else None) for n, run in enumerate(runs)}
    costs = {name: cost_of(hours, one, machine, fps=fps, minutes=minutes) for name, one in figures.items()}
    if as_json:
        both = {name: {"figures": asdict(figures[name]), **told(one)} for name, one in costs.items()}
        typer.echo(json.dumps(both).replace("Infinity", "null"))
    else:
        print_table(format_costs(costs))
