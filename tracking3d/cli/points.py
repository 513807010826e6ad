"""``tracking3d points``: where surface points are in every frame of a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, numbers
from tracking3d.errors import InputError, OutputError

if TYPE_CHECKING:
    from tracking3d.results.correspondences import PointTracks
    from tracking3d.results.run_reader import RunReader
    from tracking3d.video import FrameSource

_RATE = 25.0  # frames per second of a video of images


def points(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    xy: Annotated[
        list[str] | None, typer.Option(metavar="X,Y", help="A pixel of that frame; may be repeated.")
    ] = None,
    grid: Annotated[
        int | None,
        typer.Option(metavar="STEP", min=1, help="Pixels at such distances all over the object."),
    ] = None,
    frame: Annotated[int, typer.Option(help="Index of the frame the pixels are in.")] = 0,
    source: Annotated[
        str | None,
        typer.Option(
            metavar="SOURCE", help="The video, where it is not where it was.", show_default="as the run"
        ),
    ] = None,
    any_pixel: Annotated[
        bool,
        typer.Option("--any", help="Follow pixels beside the object too, in the images alone."),
    ] = False,
    by_mesh: Annotated[
        bool, typer.Option("--by-mesh", help="Carry points by mesh and pose alone; looks at no image.")
    ] = False,
    causal: Annotated[
        bool, typer.Option("--causal", help="Begin with the answers before the final refinement.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    csv: Annotated[Path | None, typer.Option("--csv", metavar="FILE", help="Write a CSV file.")] = None,
    video: Annotated[
        Path | None,
        typer.Option("--video", metavar="FILE", help="Write an MP4 of the points and their trails."),
    ] = None,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Follow surface points through all frames: position, visibility, uncertainty.

    Mesh and poses predict where a point goes and whether it is seen; the images correct it. What the mesh does not
    cover is followed in the images. A pixel outside the frame is an error, and so is none on the object without --any.
    """
    from tracking3d.results.correspondences import check_asked, grid_on_object, on_mask, track_points
    from tracking3d.results.point_files import points_to_csv, points_to_json
    from tracking3d.results.point_tracking import open_scene
    from tracking3d.results.point_trails import write_trails
    from tracking3d.results.run_reader import RunReader

    pixels = [numbers(text, 2, "--xy", "X,Y in pixels") for text in xy or []]
    if not pixels and grid is None:
        raise InputError(
            "No point is asked for; give pixels by --xy X,Y, or --grid STEP for all of the object."
        )
    if any_pixel and by_mesh:
        raise InputError(
            "--any follows points in the images, and --by-mesh looks at none; leave one of them out."
        )
    for file in (csv, video):
        if file is not None and not file.absolute().parent.is_dir():
            raise OutputError(f"{file} cannot be written: there is no folder {file.parent}; make it first.")
    reader = RunReader(run, refined=not causal)
    if grid is not None:
        pixels += grid_on_object(reader, frame, grid)
    # Bad questions are told before the video is read.
    tracks = track_points(reader, frame, pixels)
    images: FrameSource | None = None
    if not by_mesh or video is not None:
        images = _images(reader, source, needed=any_pixel or source is not None or video is not None)
    answered = tracks.on_object | any_pixel
    if images is not None and not by_mesh:
        answered |= on_mask(reader, frame, tracks.query)
    otherwise = "" if by_mesh else ", or --any to follow them in the images alone"
    told = [reader.not_finished, check_asked(tracks, reader.camera, answered, otherwise)]
    if images is not None and not by_mesh:
        tell = (
            (lambda done: None) if quiet else (lambda done: typer.echo(f"landmarks, round {done}", err=True))
        )
        tracks = open_scene(reader, images, after_round=tell).track(frame, pixels, any_pixel)
        if not quiet:
            told.append(_by_images(tracks))
    for sentence in told:
        if sentence:
            typer.echo(sentence, err=True)
    if csv is not None:
        try:
            csv.write_text(points_to_csv(tracks), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{csv} cannot be written: {error.strerror}.") from error
    if video is not None and images is not None:
        write_trails(video, images, tracks, images.fps or _RATE)
    if as_json:
        typer.echo(points_to_json(tracks))
    elif csv is None and video is None:
        typer.echo(points_to_csv(tracks), nl=False)


def _by_images(tracks: PointTracks) -> str:
    """What to say of points that the mesh does not cover where they were asked for; empty where there are none."""
    alone, tied = (int((tracks.kind == kind).sum()) for kind in ("image", "tied"))
    if not alone + tied:
        return ""
    count = f"{alone + tied} of {len(tracks.kind)} points"
    return (
        f"Followed in the images: {count}; {tied} of them came to lie on the mesh, which carries them since."
    )


def _images(reader: RunReader, source: str | None, needed: bool) -> FrameSource | None:
    """The video of the run; where it is gone and not needed, None, and a word about it."""
    from tracking3d.results.run_source import open_run_source

    try:
        return open_run_source(reader, source)
    except InputError as error:
        if needed:
            raise
        typer.echo(f"Points are carried by mesh and pose alone. {error}", err=True)
        return None
