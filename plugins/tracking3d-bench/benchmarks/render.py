"""How long PyTorch3D takes for what the renderer's backends do; `tracking3d bench render` times those alone.

python benchmarks/render.py --size 128 --frames 7
"""

from __future__ import annotations

from typing import Annotated

import typer

from script import run


def render(
    size: Annotated[int, typer.Option(min=16, max=1024, help="Side of the window in pixels.")] = 128,
    frames: Annotated[int, typer.Option(min=1, max=64, help="Frames in one batch.")] = 7,
    channels: Annotated[int, typer.Option(min=1, max=512, help="Feature channels.")] = 3,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Measurements; the median counts.")] = 15,
    threads: Annotated[int, typer.Option(min=1, max=256, help="CPU threads of every backend.")] = 1,
    device: Annotated[str, typer.Option(help="cpu, cuda or cuda:N.")] = "cpu",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
) -> None:
    """Time one forward and backward pass of the renderer's backends and of PyTorch3D, which has to be installed."""
    import json

    from pytorch3d_renderer import render_pytorch3d, why_no_pytorch3d
    from tracking3d.cli.tables import print_table
    from tracking3d.errors import InputError
    from tracking3d_bench.speed.benchmark import benchmark
    from tracking3d_bench.speed.table import format_problem, format_times
    from tracking3d_bench.speed.timing import find_device

    if why := why_no_pytorch3d(find_device(device)):
        raise InputError(f"PyTorch3D cannot be timed: {why}; see https://pytorch3d.org on how to install it.")
    report = benchmark(
        size,
        frames,
        channels,
        repeats=repeats,
        threads=threads,
        device=device,
        dense=False,
        others={"pytorch3d": render_pytorch3d},
    )
    if as_json:
        typer.echo(json.dumps(report))
        return
    print_table(format_times(report))
    typer.echo(format_problem(report))


if __name__ == "__main__":
    run(render)
