"""``tracking3d model``: the mesh of a run with a texture at the resolution of its video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug


def model(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    source: Annotated[
        str | None, typer.Option(help="The video, where it is no longer where the run names it.")
    ] = None,
    views: Annotated[int, typer.Option(min=1, max=500, help="Frames the texture is taken from.")] = 24,
    largest: Annotated[int, typer.Option(min=64, max=8192, help="Most texels along a side.")] = 2048,
    debug: Debug = False,
) -> None:
    """Take the texture of a run's mesh from its video anew, at the video's resolution.

    `tracking3d run` does so at its end where there is a final refinement.
    """
    from tracking3d.reconstruction.of_run import texture_run

    made, taken = texture_run(run, source, views, largest)
    size = len(made.texture)
    typer.echo(f"{run}: texture of {size} x {size} texels from {taken} frames")
