"""``tracking3d run --split``: track a long video in parts, and print a summary."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.cli.tracking import RunDisplay, RunRequest
    from tracking3d.submaps.job import SplitResult


def track_in_parts(request: RunRequest, display: RunDisplay, length: str, workers: int | None) -> None:
    """Track a video in parts, show the progress, and print a summary.

    Args:
        request: What is tracked.
        display: What is shown.
        length: Length of a part, as ``--split`` has it.
        workers: Processes at the same time; one per processor if None.

    Raises:
        InputError: Options do not go together.
    """
    from tracking3d.cli.plans import plan_run
    from tracking3d.cli.progress import show_progress
    from tracking3d.cli.report import report_at_end
    from tracking3d.submaps.split_run import record_in_parts
    from tracking3d.video import open_source

    _check(request, workers, display)
    if display.quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    folder, options = request.folder, request.options
    with ExitStack() as ends:
        ends.enter_context(_resumable(folder))
        count = open_source(request.source, options.selection).count
        plan = plan_run(request.config.model_dump(), count, report=display.report)
        shown = ends.enter_context(show_progress(display.quiet, plan))
        reporting = ends.enter_context(report_at_end([folder] if display.report else []))
        listener = reporting(shown.show_frame)
        ended = record_in_parts(
            request.source,
            request.config,
            folder,
            request.prompts,
            length=length,
            workers=workers or _processors(),
            selection=options.selection,
            command=options.command,
            overwrite=options.overwrite,
            resume=options.resume,
            listener=listener,
        )
    if not display.quiet:
        _print_summaries(ended)


def _print_summaries(ended: SplitResult) -> None:
    """Print the closing table, or those of all parts and why they could not be merged."""
    from tracking3d.cli.summary import print_summary

    for one in ended.folders:
        print_summary(one)
    if len(ended.folders) > 1:
        folders = ", ".join(map(str, ended.folders))
        typer.echo(
            f"The {ended.parts} parts could not be merged: {ended.reason}. Each is a run of its own: {folders}.",
            err=True,
        )
    elif ended.reason:
        typer.echo(
            f"Tracked as one part: {ended.reason}. --split is for long videos, and photos need none.",
            err=True,
        )


def _check(request: RunRequest, workers: int | None, display: RunDisplay) -> None:
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: give at least 1.")
    if len(request.prompts) > 1:
        raise InputError("--split tracks one object; give one object, or leave out --split.")
    given = {
        "--start-frame": request.prompts.start_frame is not None,
        "--correct": bool(request.corrections),
        "--view": display.view,
        "--fps": request.fps is not None,
    }
    for option, value in given.items():
        if value:
            raise InputError(f"{option} cannot be combined with --split; leave out one of them.")


def _processors() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _resumable(folder: Path) -> Iterator[None]:
    """If the run is stopped, say how to continue it."""
    from tracking3d.submaps.plan import PARTS

    try:
        yield
    except BaseException as error:
        if (folder / PARTS).is_dir():
            error.add_note(
                f"Finished parts are kept in {folder}; to continue, repeat the command with --resume."
            )
        raise
