"""``tracking3d export``: a run in the format of another tool."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, numbers
from tracking3d.errors import InputError


def export(
    run: Annotated[Path | None, typer.Argument(metavar="RUN", help="Run folder.")] = None,
    to: Annotated[str | None, typer.Option(metavar="FORMAT", help="Format; --list shows all.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="PATH", help="File or folder to write; one in RUN/export if left out."),
    ] = None,
    answers: Annotated[
        str, typer.Option(metavar="causal|final", help="Answers before or after the final refinement.")
    ] = "final",
    object_size: Annotated[
        float | None,
        typer.Option(metavar="METRES", help="The object's longest side; lengths are then in metres."),
    ] = None,
    of: Annotated[
        str,
        typer.Option(
            metavar="object|camera", help="Whose poses: the object's, or those of the camera about it."
        ),
    ] = "object",
    fps: Annotated[
        float | None, typer.Option(metavar="NUMBER", help="Frames per second of the source.")
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(metavar="PATH", help="The video, where it is no longer where the run found it."),
    ] = None,
    cut_out: Annotated[
        bool, typer.Option("--cut-out", help="Pictures as PNG, transparent around the object.")
    ] = False,
    images: Annotated[
        bool, typer.Option("--images/--no-images", help="Whether pictures are written along.")
    ] = True,
    undistorted: Annotated[
        bool,
        typer.Option(
            "--undistorted", help="Masks without the distortion of the lens, as poses and cameras are."
        ),
    ] = False,
    xy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="X,Y", help="A pixel on the object to follow; may be repeated. A grid if left out."
        ),
    ] = None,
    frame: Annotated[int | None, typer.Option(help="Index of the frame those pixels are in.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier export.")] = False,
    list_formats: Annotated[bool, typer.Option("--list", help="List the formats.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write poses, masks, points, model or scene of a run in the format of another tool.

    Nothing is replaced without --overwrite, and what is written appears whole or not at all.
    """
    if list_formats:
        _print_formats(as_json)
        return
    if run is None or to is None:
        raise InputError("export takes RUN and --to FORMAT; --list shows the formats.")
    from tracking3d.export.exporting import export_run
    from tracking3d.export.options import ExportOptions

    pixels = tuple(numbers(text, 2, "--xy", "X,Y in pixels") for text in xy or ())
    options = ExportOptions(
        answers=answers,  # type: ignore[arg-type] # texts are checked where the library's are
        object_size=object_size,
        fps=fps,
        source=source,
        of=of,  # type: ignore[arg-type]
        cut_out=cut_out,
        images=images,
        undistorted=undistorted,
        frame=frame,
        xy=pixels,  # type: ignore[arg-type]
    )
    done = export_run(run, to, out, options=options, overwrite=overwrite)
    if done.not_finished:
        typer.echo(done.not_finished, err=True)
    if as_json:
        import json

        document = {"path": str(done.path), "unit": done.unit, "frames": done.frames}
        typer.echo(json.dumps(document | {"without": list(done.without)}))
    elif not quiet:
        typer.echo(f"{done.path} is written, {done.in_words}.")


def _print_formats(as_json: bool) -> None:
    import json

    from tracking3d.export.formats import FORMATS

    if as_json:
        rows = [
            {
                "name": one.name,
                "kind": one.kind,
                "writes": one.writes,
                "suffix": one.suffix,
                "extra": one.extra or None,
                "available": one.is_available,
                "options": sorted(one.options),
            }
            for one in FORMATS.values()
        ]
        typer.echo(json.dumps(rows, indent=2))
        return
    from rich.markup import escape
    from rich.table import Table

    from tracking3d.cli.tables import print_table

    table = Table("name", "kind", "writes", "file", "needs")
    for one in FORMATS.values():
        needs = "" if one.is_available else f"pip install 'tracking3d[{one.extra}]'"
        table.add_row(*map(escape, (one.name, one.kind, one.writes, one.suffix or "folder", needs)))
    print_table(table)
