"""Does a long run stay flat in memory, open files and seconds a frame?

python benchmarks/soak.py --frames 10000 --plot soak.png
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from script import run
from tracking3d.cli.options import ConfigFile, Overrides, Preset


def soak(
    frames: Annotated[int, typer.Option(min=1, help="How many frames.")] = 10_000,
    hours: Annotated[
        float | None, typer.Option(min=0.001, help="Run for so long, instead of so many frames.")
    ] = None,
    width: Annotated[
        int, typer.Option(min=64, max=4096, help="Width of the frames; the height is 3/4.")
    ] = 160,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep the run folder there.", show_default="a temporary one"),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw all of it into an .svg, .png or .pdf.")
    ] = None,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
) -> None:
    """Track an object that leaves and returns for 10,000 frames; the exit code is 1 if memory or time keeps growing."""
    import json
    import tempfile
    from dataclasses import asdict

    from looped_run import track_looped
    from soak_report import format_soak, plot_soak
    from tracking3d.cli.options import configure
    from tracking3d.cli.tables import print_table
    from tracking3d_bench.speed.plot import check_plot

    if plot:
        check_plot(plot)
    settings = configure(config, preset, overrides)
    with tempfile.TemporaryDirectory() as temporary:
        report = track_looped(
            settings, out or Path(temporary) / "run", frames, hours, (width, width * 3 // 4)
        )
    if plot:
        plot_soak(report, plot)
    if as_json:
        typer.echo(json.dumps(asdict(report) | {"flat": report.flat}))
    else:
        print_table(format_soak(report))
    if not report.flat:
        raise typer.Exit(1)


if __name__ == "__main__":
    run(soak)
