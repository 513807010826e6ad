"""``tracking3d run --split``: track a long video in parts, and print a summary."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.cli.tracking import Given, RunDisplay
    from tracking3d.config.models import PipelineConfig
    from tracking3d.splitting.long_video import Ended


def track_in_parts(
    source: str,
    settings: PipelineConfig,
    folder: Path,
    given: Given,
    arguments: dict[str, Any],
    length: str,
    *,
    workers: int | None,
    fps: float | None,
    display: RunDisplay,
) -> None:
    """Track a video in parts, show the progress, and print a summary; see `tracking3d.cli.tracking.track`.

    Args:
        source: The command's argument SOURCE.
        settings: The configuration.
        folder: The run folder.
        given: What the object is.
        arguments: Further arguments of `tracking3d.recording.record`.
        length: Length of a part, as ``--split`` has it.
        workers: Processes at the same time; one per processor if None.
        fps: Value of ``--fps``.
        display: What is shown.

    Raises:
        InputError: Options do not go together.
    """
    from tracking3d.cli.progress import progress
    from tracking3d.cli.report import reported
    from tracking3d.splitting.part_runs import Given as GivenOfPart
    from tracking3d.splitting.split_run import record_in_parts
    from tracking3d.video import open_source

    _check(given, arguments, workers, display.view, fps)
    if display.quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    box, mask, points = (next(iter(one), None) for one in (given.boxes, given.masks, given.points))
    with ExitStack() as ends:
        ends.enter_context(_resumable(folder))
        reporting = ends.enter_context(reported([folder] if display.report else []))
        count = open_source(source, arguments["selection"]).count
        listener = reporting(ends.enter_context(progress(count, display.quiet)))
        ended = record_in_parts(
            source,
            settings,
            folder,
            GivenOfPart(box, mask, points),
            length=length,
            workers=workers or _processors(),
            selection=arguments["selection"],
            command=arguments["command"],
            overwrite=arguments["overwrite"],
            resume=arguments["resume"],
            listener=listener,
        )
    if not display.quiet:
        _print_summaries(ended)


def _print_summaries(ended: Ended) -> None:
    """Print the closing table, or those of all parts and why they could not be merged."""
    from tracking3d.cli.progress import print_summary

    for one in ended.folders:
        print_summary(one)
    if len(ended.folders) > 1:
        folders = ", ".join(map(str, ended.folders))
        typer.echo(
            f"The {ended.parts} parts could not be merged: {ended.reason}. Each is a run of its own: {folders}.",
            err=True,
        )
    elif ended.reason:
        typer.echo(f"Tracked as one part: {ended.reason}.", err=True)


def _check(
    given: Given, arguments: dict[str, Any], workers: int | None, view: bool, fps: float | None
) -> None:
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: give at least 1.")
    if len(given) > 1:
        raise InputError("--split tracks one object; give one object, or leave out --split.")
    for option, value in {
        "--start-frame": arguments["start_frame"] is not None,
        "--correct": bool(arguments["corrections"]),
        "--view": view,
        "--fps": fps is not None,
    }.items():
        if value:
            raise InputError(f"{option} cannot be combined with --split; leave out one of them.")


def _processors() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """If the run is stopped, say how to continue it."""
    from tracking3d.splitting.plan import PARTS

    try:
        yield
    except BaseException as error:
        if (folder / PARTS).is_dir():
            error.add_note(
                f"Finished parts are kept in {folder}; to continue, repeat the command with --resume."
            )
        raise
