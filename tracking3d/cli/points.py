"""``tracking3d points``: track surface points through every frame of a run."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

from tracking3d.cli.options import Debug, Quiet, Run, Video, grouped, numbers
from tracking3d.cli.options.general import OUTPUT
from tracking3d.cli.options.output import ObjectSize
from tracking3d.errors import InputError, OutputError

if TYPE_CHECKING:
    from tracking3d.geometry.similarity import Similarity
    from tracking3d.results.correspondences import PointTracks
    from tracking3d.results.run_reader import RunReader
    from tracking3d.video import FrameSource

_RATE = 25.0  # frames per second, for images without a frame rate


@dataclass(frozen=True)
class QueryOptions:
    """Which points are tracked, and from what."""

    PANEL: ClassVar = "Query"

    xy: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y", help="Pixel to track from the query frame; may be repeated."),
    ] = None
    grid: Annotated[
        int | None,
        typer.Option(
            metavar="STEP", min=1, help="Track a grid of pixels with this spacing over the whole object."
        ),
    ] = None
    frame: Annotated[int, typer.Option(metavar="N", help="Query frame, which the pixels are in.")] = 0
    any_pixel: Annotated[
        bool,
        typer.Option("--any", help="Track pixels on the background too, from the images alone."),
    ] = False
    by_mesh: Annotated[
        bool,
        typer.Option("--by-mesh", help="Move points with mesh and pose alone; the images are not read."),
    ] = False
    causal: Annotated[
        bool,
        typer.Option("--causal", help="Start from the estimates before the final refinement."),
    ] = False
    other: Annotated[
        Path | None,
        typer.Option(
            "--in",
            metavar="RUN",
            help="Track the points in another run of the same object, too, for example one with --object of this run.",
        ),
    ] = None
    source: Video = None
    object_size: ObjectSize = None

    def pixels(self) -> list[tuple[float, ...]]:
        """The pixels of ``--xy``.

        Raises:
            InputError: One cannot be read, no point is given, or two options contradict each other.
        """
        pixels = [numbers(text, 2, "--xy", "X,Y in pixels") for text in self.xy or []]
        if not pixels and self.grid is None:
            raise InputError(
                "No point is given; give pixels with --xy X,Y, or --grid STEP to cover the whole object."
            )
        if self.any_pixel and self.by_mesh:
            raise InputError(
                "--any tracks points in the images, which --by-mesh does not read; leave out one of them."
            )
        if self.other is not None and (self.any_pixel or self.by_mesh):
            raise InputError(
                "--in tracks points of the object by the images of both runs; leave out --any and --by-mesh."
            )
        return pixels


@grouped
def points(
    run: Run,
    query: QueryOptions,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.", rich_help_panel=OUTPUT)] = False,
    csv: Annotated[
        Path | None,
        typer.Option("--csv", metavar="FILE", help="Write a CSV file.", rich_help_panel=OUTPUT),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            "--video",
            metavar="FILE",
            help="Write an MP4 video of the points and their trails.",
            rich_help_panel=OUTPUT,
        ),
    ] = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Track surface points through all frames: position, visibility and uncertainty.

    Mesh and poses predict where a point is and whether it is visible; the images correct the prediction. Points that
    the mesh does not cover are tracked in the images. A pixel outside the frame is an error, and so is one off the
    object without --any.
    """
    from tracking3d.results.layout import check_run_folder

    pixels = query.pixels()
    for folder in (run, *([query.other] if query.other else ())):
        check_run_folder(folder)
    for file in (csv, video):
        if file is not None and not file.absolute().parent.is_dir():
            raise OutputError(
                f"{file} cannot be written: the folder {file.parent} does not exist; make it first."
            )
    from tracking3d.cli.progress import load_with_progress, plan_points, show_progress

    load_with_progress("tracking3d.results.point_tracking", quiet, kernels=True)
    from tracking3d.reconstruction.extension import between_runs
    from tracking3d.results.correspondences import grid_on_object, track_points
    from tracking3d.results.run_reader import RunReader

    reader = RunReader(run, refined=not query.causal)
    scale = _scale(reader, query.object_size)
    if query.grid is not None:
        pixels += grid_on_object(reader, query.frame, query.grid)
    tracks = track_points(reader, query.frame, pixels)  # before the video is read: it may refuse the query
    other: tuple[RunReader, Similarity] | None = None
    if query.other is not None:
        there = RunReader(query.other, refined=not query.causal)
        other = there, between_runs(reader, there)
    images: FrameSource | None = None
    if not query.by_mesh or video is not None:
        needed = query.any_pixel or query.source is not None or video is not None or other is not None
        images = _images(reader, query.source, needed)
    with show_progress(quiet, plan_points(len(reader.frames))):
        tracks, in_other, remarks = _followed(reader, query, pixels, tracks, images, other)
    for remark in filter(None, remarks[:-1] if quiet else remarks):
        typer.echo(remark, err=True)
    if scale is not None:
        tracks = replace(tracks, points=tracks.points * scale)
        if in_other is not None and other is not None:
            in_other = replace(in_other, points=in_other.points * scale / other[1].scale)
    with show_progress(quiet):
        _write_files(tracks, in_other, images, csv, video)
    if as_json or (csv is None and video is None):
        _print(tracks, as_json, in_other)


def _scale(reader: RunReader, object_size: float | None) -> float | None:
    """Metres per unit of the run, if the length of the object is given."""
    if object_size is None:
        return None
    from tracking3d.results.mesh_export import load_model
    from tracking3d.results.run_unit import metres_per_unit

    return metres_per_unit(load_model(reader.mesh_folder), object_size)


def _followed(
    reader: RunReader,
    query: QueryOptions,
    pixels: list[tuple[float, ...]],
    tracks: PointTracks,
    images: FrameSource | None,
    other: tuple[RunReader, Similarity] | None,
) -> tuple[PointTracks, PointTracks | None, list[str]]:
    """The tracks that the images correct, if they are read, those in the other run, and what to print about them."""
    from tracking3d.results.correspondences import check_asked, on_mask
    from tracking3d.results.point_tracking import open_scene

    in_other: PointTracks | None = None
    by_images = images is not None and not query.by_mesh
    covered = tracks.on_object | query.any_pixel
    if by_images:
        covered |= on_mask(reader, query.frame, tracks.query)
    otherwise = "" if query.by_mesh else ", or --any to follow them in the images alone"
    remarks = [reader.not_finished, check_asked(tracks, reader.camera, covered, otherwise)]
    if images is not None and by_images:
        scene = open_scene(reader, images)
        tracks = scene.track(query.frame, pixels, query.any_pixel)
        if other is not None:
            remarks.append(other[0].not_finished)
            in_other = scene.track_in(open_scene(other[0]), other[1], query.frame, pixels)
    return tracks, in_other, [*filter(None, remarks), _by_images(tracks)]


def _write_files(
    tracks: PointTracks,
    there: PointTracks | None,
    images: FrameSource | None,
    csv: Path | None,
    video: Path | None,
) -> None:
    from tracking3d.results.correspondences import points_to_csv
    from tracking3d.results.point_trails import write_trails

    if csv is not None:
        try:
            csv.write_text(points_to_csv(tracks, there), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{csv} cannot be written: {error.strerror}.") from error
    if video is not None and images is not None:
        write_trails(video, images, tracks, images.fps or _RATE)


def _print(tracks: PointTracks, as_json: bool, there: PointTracks | None = None) -> None:
    from tracking3d.results.correspondences import points_to_csv, points_to_json

    if as_json:
        typer.echo(points_to_json(tracks, there))
    elif not sys.stdout.isatty():
        typer.echo(points_to_csv(tracks, there), nl=False)
    else:
        from rich.table import Table

        from tracking3d.cli.tables import print_table

        heads, *rows = (line.split(",") for line in points_to_csv(tracks, there).splitlines())
        table = Table(*heads)
        for row in rows:
            table.add_row(*row)
        print_table(table)


def _by_images(tracks: PointTracks) -> str:
    """What to print about points that the mesh does not cover in the query frame; empty if there are none."""
    alone, tied = (int((tracks.kind == kind).sum()) for kind in ("image", "tied"))
    if not alone + tied:
        return ""
    count = f"{alone + tied} of {len(tracks.kind)} points"
    return (
        f"Tracked in the images: {count}; {tied} of them reached the mesh later and move with it from there."
    )


def _images(reader: RunReader, source: str | None, needed: bool) -> FrameSource | None:
    """The video of the run; None, with a remark, if it is missing and not needed."""
    from tracking3d.results.run_reader import open_run_source

    try:
        return open_run_source(reader, source)
    except InputError as error:
        if needed:
            raise
        typer.echo(f"Points move with mesh and pose alone. {error}", err=True)
        return None
