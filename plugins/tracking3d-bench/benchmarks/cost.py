"""What many hours of video cost, by the figures of finished runs.

python benchmarks/cost.py runs/box runs/cup --hours 1000 --fps 30
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from script import run


def cost(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Finished run folders.")],
    hours: Annotated[float, typer.Option(help="Hours of video.")] = 1000.0,
    fps: Annotated[float, typer.Option(help="Frames a second of the videos.")] = 30.0,
    minutes: Annotated[float, typer.Option(help="Mean length of a video.")] = 1.0,
    processors: Annotated[int, typer.Option(min=1, help="Processors of a machine.")] = 16,
    memory: Annotated[float, typer.Option(min=0.1, help="Memory of a machine, in GB.")] = 64.0,
    disk: Annotated[float, typer.Option(min=0.001, help="Disk bandwidth, in MB/s.")] = 200.0,
    network: Annotated[float, typer.Option(min=0.001, help="Network bandwidth, in MB/s.")] = 125.0,
    video: Annotated[
        Path | None, typer.Option(metavar="PATH", help="Video of the first run, for the bytes that are read.")
    ] = None,
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
) -> None:
    """Print the time, disk and memory that many hours of video cost, and which resource is the bottleneck."""
    import json
    from dataclasses import asdict

    from tracking3d.cli.tables import print_table
    from video_costs import Machine, as_json, cost_of, figures_of, format_costs

    machine = Machine(processors, 1e9 * memory, 1e6 * disk, 1e6 * network)
    figures = {str(run): figures_of(run, video if n == 0 else None) for n, run in enumerate(runs)}
    costs = {name: cost_of(hours, one, machine, fps=fps, minutes=minutes) for name, one in figures.items()}
    if json_only:
        both = {name: {"figures": asdict(figures[name]), **as_json(one)} for name, one in costs.items()}
        typer.echo(json.dumps(both).replace("Infinity", "null"))
    else:
        print_table(format_costs(costs))


if __name__ == "__main__":
    run(cost)
