"""``tracking3d model``: rebuild the mesh of a run, its texture or its shape too."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Run, Video
from tracking3d.errors import InputError

Largest = Annotated[int, typer.Option(min=64, max=8192, help="Maximum side of the texture image, in texels.")]


class ModelQuality(StrEnum):
    """What is rebuilt: the texture, or the shape too."""

    FAST = "fast"
    FINE = "fine"


def model(
    run: Run,
    quality: Annotated[
        ModelQuality,
        typer.Option(
            help="fast re-textures the online mesh, fine also reconstructs the shape from all frames."
        ),
    ] = ModelQuality.FAST,
    source: Video = None,
    views: Annotated[int, typer.Option(min=1, max=500, help="Frames that the texture is taken from.")] = 24,
    largest: Largest = 2048,
    debug: Debug = False,
) -> None:
    """Re-texture the mesh of a run from its video, and with --quality fine reconstruct its shape too.

    `tracking3d run` does this at its end; its option --model chooses how.
    """
    from tracking3d.results.layout import check_run_folder

    check_run_folder(run)
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
    """Make sure, before anything is tracked, that the shape can be reconstructed at the end.

    Raises:
        InputError: The source is a camera, whose frames cannot be read twice.
        PluginError: A package is missing.
    """
    from tracking3d.reconstruction.rebuild import check_packages

    if source.isdigit() and not Path(source).exists():
        raise InputError(
            "--model fine reads the video a second time, which a camera does not allow; leave it out."
        )
    check_packages()
