"""``tracking3d bench render``: how fast the renderer is on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug


def render(
    size: Annotated[int, typer.Option(min=16, max=1024, help="Side of the window in pixels.")] = 128,
    frames: Annotated[int, typer.Option(min=1, max=64, help="Frames in one batch.")] = 7,
    channels: Annotated[int, typer.Option(min=1, max=512, help="Feature channels.")] = 3,
    texture: Annotated[
        int | None,
        typer.Option(
            min=8,
            max=2048,
            help="Side of the texture in texels.",
            show_default="300 up to 16 channels, 150 above",
        ),
    ] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Measurements; the median counts.")] = 15,
    threads: Annotated[int, typer.Option(min=1, max=256, help="CPU threads of every backend.")] = 1,
    device: Annotated[str, typer.Option(help="cpu, cuda or cuda:N.")] = "cpu",
    no_dense: Annotated[
        bool,
        typer.Option("--no-dense", help="Leave out the dense implementation, which takes most of the time."),
    ] = False,
    growth: Annotated[
        bool,
        typer.Option("--growth", help="Measure how the times grow with pixels, faces, frames, channels."),
    ] = False,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Draw the growth into an .svg, .png or .pdf; implies --growth."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Time one forward and backward pass of the renderer's backends and of a dense implementation."""
    import json

    from tracking3d_bench.speed.benchmark import benchmark
    from tracking3d_bench.speed.plot import check_plot, plot_growth

    if plot:
        check_plot(plot)
    report = benchmark(
        size,
        frames,
        channels,
        texture,
        repeats,
        threads,
        device,
        dense=not no_dense,
        growth=growth or bool(plot),
    )
    if plot:
        plot_growth(report["growth"], plot)
    if as_json:
        typer.echo(json.dumps(report))
        return
    from tracking3d.cli.tables import print_table
    from tracking3d_bench.speed.table import format_growth, format_problem, format_times

    print_table(format_times(report))
    typer.echo(format_problem(report))
    if "growth" in report:
        print_table(format_growth(report["growth"]))
