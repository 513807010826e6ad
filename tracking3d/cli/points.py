"""``tracking3d points``: where surface points are in every frame of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, numbers
from tracking3d.errors import OutputError


def points(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    xy: Annotated[list[str], typer.Option(metavar="X,Y", help="A pixel of that frame; may be repeated.")],
    frame: Annotated[int, typer.Option(help="Index of the frame the pixels are in.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write a CSV file.")] = None,
    debug: Debug = False,
) -> None:
    """Follow the surface points under some pixels of one frame: position and visibility in every frame.

    A pixel outside the frame is an error, and so is none on the object.
    """
    from tracking3d.results.correspondences import check_asked, track_points
    from tracking3d.results.point_files import points_to_csv, points_to_json
    from tracking3d.results.run_reader import RunReader

    pixels = [numbers(text, 2, "--xy", "X,Y in pixels") for text in xy]
    reader = RunReader(run)
    tracks = track_points(reader, frame, pixels)
    for told in (reader.not_finished, check_asked(tracks, reader.camera)):
        if told:
            typer.echo(told, err=True)
    if csv is not None:
        try:
            csv.write_text(points_to_csv(tracks), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{csv} cannot be written: {error.strerror}.") from error
    if as_json:
        typer.echo(points_to_json(tracks))
    elif csv is None:
        typer.echo(points_to_csv(tracks), nl=False)
