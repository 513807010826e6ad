"""``tracking3d calibrate``: intrinsics and lens distortion from views of a printed board."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import Debug, Quiet
from tracking3d.cli.options.general import VIDEO
from tracking3d.cli.program import WithDefault
from tracking3d.errors import InputError, OutputError

if TYPE_CHECKING:
    from tracking3d.geometry.calibration.calibrate import Board, Calibration

MOST_FRAMES = 150
"""Frames of a video in which the board is detected, spread evenly over it."""
_PIXELS = 320
"""Pixels along the side of a printed square."""
_MARGIN = 0.2
"""White margin around a printed board, in squares; detection needs it."""
_MILLIMETRES_AN_INCH = 25.4


class _VideoFirst(WithDefault):
    default = "video"


app = typer.Typer(
    cls=_VideoFirst,
    help="Calibrate a camera and its lens from views of a printed board.",
    no_args_is_help=True,
)

Kind = Annotated[str, typer.Option("--board", metavar="charuco|chessboard", help="Kind of board.")]
Squares = Annotated[
    str, typer.Option(metavar="COLUMNSxROWS", help="Columns and rows of squares; black and white ones count.")
]
Millimetres = Annotated[float, typer.Option("--square-mm", help="Side of a square in millimetres.")]


@app.command(name="board")
def print_board(
    out: Annotated[Path, typer.Option(metavar="FILE.png|FILE.pdf", help="File to write.")],
    kind: Kind = "charuco",
    squares: Squares = "7x10",
    square: Millimetres = 25.0,
    debug: Debug = False,
) -> None:
    """Draw a board to print at its true size; the default fits on A4 and Letter paper."""
    import numpy as np
    from PIL import Image as Pillow

    if out.suffix.casefold() not in (".png", ".pdf"):
        raise InputError(f"--out {out} is neither a .png nor a .pdf file.")
    board = _board(kind, squares, square)
    drawn = np.pad(board.picture(_PIXELS), round(_MARGIN * _PIXELS), constant_values=255)
    # The resolution makes a square exactly as long as given.
    resolution = _PIXELS / board.square * _MILLIMETRES_AN_INCH
    page = Pillow.fromarray(drawn)
    try:
        if out.suffix.casefold() == ".pdf":
            page.save(out, resolution=resolution)
        else:
            page.save(out, dpi=(resolution, resolution))
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error.strerror or error}.") from error
    height, width = (side / _PIXELS * board.square for side in drawn.shape)
    typer.echo(
        f"{out}: {board.columns} x {board.rows} squares of {board.square:g} mm, {width:.0f} x {height:.0f} mm in total"
    )
    typer.echo(
        "Print it at 100 %, mount it on something flat, and film it near and far, tilted, and in the image corners."
    )


@app.command(name="video")
def video(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Video or image folder that shows the board.")
    ],
    out: Annotated[Path, typer.Option(metavar="FILE.yaml", help="Camera file to write.")] = Path(
        "camera.yaml"
    ),
    kind: Kind = "charuco",
    squares: Squares = "7x10",
    square: Millimetres = 25.0,
    model: Annotated[
        str,
        typer.Option(
            metavar="radtan|fisheye",
            help="Distortion model; use fisheye for fields of view above about 120 degrees.",
        ),
    ] = "radtan",
    frames: Annotated[
        str | None,
        typer.Option(
            metavar="START:STOP:STEP",
            help="Frames to use; default 150, spread over the video.",
            rich_help_panel=VIDEO,
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Calibrate the camera that filmed SOURCE, and write a file for `tracking3d run --camera`.

    The file is OpenCV's YAML, with intrinsics, distortion, image size, reprojection error and coverage.
    """
    from tracking3d.geometry.calibration.calibrate import calibrate
    from tracking3d.geometry.calibration.camera_files import write_camera
    from tracking3d.video import open_source

    if model not in ("radtan", "fisheye"):
        raise InputError(f"--model {model} is unknown; give radtan or fisheye.")
    board = _board(kind, squares, square)
    if out.exists() and not overwrite:
        raise OutputError(f"{out} already exists; give another --out, or --overwrite.")
    if not out.absolute().parent.is_dir():
        raise OutputError(f"{out} cannot be written: the folder {out.parent} does not exist; make it first.")
    opened = open_source(source, frames)
    if frames is None and opened.count is not None and opened.count > MOST_FRAMES:
        opened = open_source(source, f"::{-(-opened.count // MOST_FRAMES)}")
    elif opened.count is None and frames is None and not opened.repeatable:
        raise InputError(f"{opened.name} has no end; give the frames to use with --frames.")
    found = calibrate(opened, board, "fisheye" if model == "fisheye" else "radtan", opened.name)
    notes = {
        "avg_reprojection_error": round(found.error, 4),
        "views": len(found.errors),
        "coverage": round(found.coverage, 3),
    }
    try:
        write_camera(out, found.camera, notes)
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error.strerror}.") from error
    if not quiet:
        _print(found, out)


def _board(kind: str, squares: str, square: float) -> Board:
    from tracking3d.geometry.calibration.calibrate import Board, parse_squares

    if kind not in ("charuco", "chessboard"):
        raise InputError(f"--board {kind} is unknown; give charuco or chessboard.")
    columns, rows = parse_squares(squares)
    return Board(columns, rows, "chessboard" if kind == "chessboard" else "charuco", square)


def _print(found: Calibration, out: Path) -> None:
    fx, fy, cx, cy = found.camera.intrinsics
    give = "" if found.focal_deviation is None else f" (+- {found.focal_deviation:.2g})"
    typer.echo(f"{out}: focal lengths {fx:.2f}, {fy:.2f}{give}, centre {cx:.2f}, {cy:.2f}")
    typer.echo(
        f"distortion ({found.camera.model}): " + ", ".join(f"{one:.5g}" for one in found.camera.coefficients)
    )
    worst = max(found.errors, key=lambda index: found.errors[index])
    typer.echo(
        f"{len(found.errors)} views, reprojection error {found.error:.3f} pixels (worst frame {worst}: "
        f"{found.errors[worst]:.3f}), {100 * found.coverage:.0f} % of the image covered"
    )
    for reason, count in Counter(found.left_out.values()).most_common():
        which = [str(index) for index, why in found.left_out.items() if why == reason]
        shown = ", ".join(which[:8]) + (" and more" if len(which) > 8 else "")
        typer.echo(f"not used, {reason}: {count} frames ({shown})")
