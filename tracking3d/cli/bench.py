"""``tracking3d bench``: how fast the parts are on this machine."""

from __future__ import annotations

from typing import Annotated

import typer

from tracking3d.cli.options import Debug

app = typer.Typer(help="Measure how fast the parts are on this machine.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    pass


@app.command()
def render(
    size: Annotated[int, typer.Option(min=16, max=1024, help="Side of the window in pixels.")] = 128,
    frames: Annotated[int, typer.Option(min=1, max=64, help="Frames in one batch.")] = 7,
    channels: Annotated[int, typer.Option(min=1, max=512, help="Feature channels.")] = 3,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Measurements; the median counts.")] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Time one forward and backward pass of the renderer's backends and of a dense implementation."""
    import json

    from tracking3d.evaluation.bench_render import benchmark

    typer.echo(json.dumps(benchmark(size, frames, channels, repeats), indent=None if as_json else 2))
