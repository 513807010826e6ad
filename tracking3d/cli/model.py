"""``tracking3d model``: the mesh of a run made anew, its shape and its texture."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug
from tracking3d.errors import InputError


class ModelQuality(StrEnum):
    """How much work a model is worth."""

    FAST = "fast"
    FINE = "fine"


def model(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    quality: Annotated[
        ModelQuality,
        typer.Option(help="fast: the mesh of the online map; fine: its shape made anew from all frames."),
    ] = ModelQuality.FAST,
    source: Annotated[
        str | None, typer.Option(help="The video, where it is no longer where the run names it.")
    ] = None,
    views: Annotated[int, typer.Option(min=1, max=500, help="Frames the texture is taken from.")] = 24,
    largest: Annotated[int, typer.Option(min=64, max=8192, help="Most texels along a side.")] = 2048,
    debug: Debug = False,
) -> None:
    """Take the texture of a run's mesh from its video anew, and with --quality fine make its shape anew too.

    `tracking3d run` takes the texture at its end where there is a final refinement.
    """
    from tracking3d.reconstruction.rebuild import rebuild_shape, retexture_run

    if quality is ModelQuality.FINE:
        shaped = rebuild_shape(run, source, views, largest)
        made, taken = shaped.model, shaped.views
        typer.echo(f"{run}: {len(made.faces)} faces; {shaped.sentence}" if shaped.new else shaped.sentence)
    else:
        made, taken = retexture_run(run, source, views, largest)
    size = len(made.texture)
    typer.echo(f"{run}: texture of {size} x {size} texels from {taken} frames")


def check_fine(source: str) -> None:
    """Make sure, before anything is tracked, that a shape can be made anew at the end."""
    from tracking3d.reconstruction.rebuild import check_packages

    if source.isdigit() and not Path(source).exists():
        raise InputError(
            "--model fine goes through the video once more, which a camera cannot; leave it out."
        )
    check_packages()
