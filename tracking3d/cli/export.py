"""``tracking3d export``: a run in the format of another tool."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

from tracking3d.cli.options import AsJson, Debug, Quiet, Video, grouped, numbers
from tracking3d.cli.options.general import OUTPUT, VIDEO
from tracking3d.cli.options.output import ObjectSize
from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.export.exporting import Export
    from tracking3d.export.options import ExportOptions


@dataclass(frozen=True)
class ContentOptions:
    """What of a run is exported."""

    PANEL: ClassVar = "Content"

    estimates: Annotated[
        str,
        typer.Option(
            "--answers", metavar="causal|final", help="Estimates before or after the final refinement."
        ),
    ] = "final"
    object_size: ObjectSize = None
    of: Annotated[
        str,
        typer.Option(
            metavar="object|camera",
            help="Poses to export: of the object in the camera, or of the camera around the object.",
        ),
    ] = "object"
    cut_out: Annotated[
        bool,
        typer.Option("--cut-out", help="Write images as PNG with a transparent background."),
    ] = False
    unseen: Annotated[
        str,
        typer.Option(
            metavar="close|cut", help="Surface that no frame has shown: keep it, marked, or leave it out."
        ),
    ] = "close"
    images: Annotated[
        bool,
        typer.Option("--images/--no-images", help="Write the images too."),
    ] = True
    undistorted: Annotated[
        bool,
        typer.Option("--undistorted", help="Remove lens distortion from masks, as poses and cameras assume."),
    ] = False
    compressed_images: Annotated[
        bool,
        typer.Option("--compressed-images", help="Include the frames of the video as JPEG."),
    ] = False
    xy: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Pixel on the object to track; may be repeated. Default: a grid."),
    ] = None
    frame: Annotated[
        int | None,
        typer.Option(metavar="N", help="Frame that these pixels are in."),
    ] = None


@dataclass(frozen=True)
class SourceOptions:
    """The video of the run."""

    PANEL: ClassVar = VIDEO

    source: Video = None
    fps: Annotated[
        float | None,
        typer.Option(metavar="NUMBER", help="Frame rate of the video."),
    ] = None
    start_time: Annotated[
        str | None,
        typer.Option(
            metavar="SECONDS|DATE",
            help="Start of the video, in seconds from 1970 or as ISO 8601; default the time at which it was recorded.",
        ),
    ] = None


@grouped
def export(
    content: ContentOptions,
    video: SourceOptions,
    run: Annotated[
        Path | None,
        typer.Argument(metavar="RUN", help="Run folder, or the folder that holds those of several objects."),
    ] = None,
    to: Annotated[
        str | None,
        typer.Option(metavar="FORMAT", help="Format; --list shows all.", rich_help_panel=OUTPUT),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="File or folder to write; default RUN/export and the name of the run.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier export.", rich_help_panel=OUTPUT)
    ] = False,
    list_formats: Annotated[bool, typer.Option("--list", help="List the formats.")] = False,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write the poses, masks, points, model or scene of a run in the format of another tool.

    An existing file is replaced only with --overwrite. A failed export leaves nothing behind.
    """
    if list_formats:
        _print_formats(as_json)
        return
    if run is None or to is None:
        raise InputError("export needs RUN and --to FORMAT; --list shows the formats.")
    from tracking3d.cli.progress import show_progress
    from tracking3d.export.exporting import export_run
    from tracking3d.results.layout import runs_in

    runs = runs_in(run)
    if out is not None and len(runs) > 1:
        raise InputError(
            f"{run} holds {len(runs)} objects, and --out is the place of one; give {runs[0]}, or no --out."
        )
    options = _exporter_options(content, video)
    for one in runs:
        with show_progress(quiet):
            done = export_run(one, to, out, options=options, overwrite=overwrite)
        _print_export(done, as_json, quiet)


def _print_export(done: Export, as_json: bool, quiet: bool) -> None:
    for sentence in filter(None, (done.not_finished, done.note)):
        typer.echo(sentence, err=True)
    if as_json:
        import json

        document = {"path": str(done.path), "unit": done.unit, "frames": done.frames}
        typer.echo(json.dumps(document | {"without": list(done.without)}))
    elif not quiet:
        typer.echo(f"Wrote {done.path}: {done.in_words}.")


def _exporter_options(content: ContentOptions, video: SourceOptions) -> ExportOptions:
    from tracking3d.export.options import ExportOptions

    pixels = tuple(numbers(text, 2, "--xy", "X,Y in pixels") for text in content.xy or ())
    return ExportOptions(
        answers=content.estimates,  # type: ignore[arg-type] # the exporter checks the texts
        object_size=content.object_size,
        fps=video.fps,
        source=video.source,
        start_time=None if video.start_time is None else _seconds(video.start_time),
        compressed_images=content.compressed_images,
        of=content.of,  # type: ignore[arg-type]
        cut_out=content.cut_out,
        unseen=content.unseen,  # type: ignore[arg-type]
        images=content.images,
        undistorted=content.undistorted,
        frame=content.frame,
        xy=pixels,  # type: ignore[arg-type]
    )


def _seconds(text: str) -> float:
    """Seconds from 1970, given as such or as a date."""
    from tracking3d.video.recording_time import seconds_since_1970

    try:
        return float(text)
    except ValueError:
        pass
    try:
        return seconds_since_1970(text)
    except ValueError as error:
        raise InputError(
            f"--start-time '{text}' is no time; write seconds from 1970, or a date such as 2026-11-25T12:00:00Z."
        ) from error


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
