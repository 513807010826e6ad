"""``tracking3d run --split``: a long video in parts, and what came of it."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.cli.tracking import Given
    from tracking3d.config.models import PipelineConfig


def track_in_parts(
    source: str,
    settings: PipelineConfig,
    folder: Path,
    given: Given,
    about: dict[str, Any],
    length: str,
    *,
    workers: int | None,
    fps: float | None,
    quiet: bool,
    report: bool,
    view: bool,
) -> None:
    """Track a video in parts, show how it goes, and print what came of it; see `tracking3d.cli.tracking.track`.

    Args:
        source: What SOURCE is.
        settings: The configuration.
        folder: The run folder.
        given: What the object is.
        about: Further arguments of `tracking3d.recording.record`.
        length: Of a part, as ``--split`` has it.
        workers: Processes at a time; as many as the machine has processors if None.
        fps: Whether ``--fps`` was given.
        quiet: Print nothing.
        report: Write a report at the end.
        view: Whether ``--view`` was given.

    Raises:
        InputError: If options do not go together.
    """
    from tracking3d.cli.progress import print_summary, progress
    from tracking3d.cli.report import reported
    from tracking3d.prompts import PromptSet
    from tracking3d.splitting.split_run import record_in_parts
    from tracking3d.video import open_source

    _check(given, about, workers, view, fps)
    if quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    with ExitStack() as ends:
        ends.enter_context(_to_be_resumed(folder))
        reporting = ends.enter_context(reported([folder] if report else []))
        listener = reporting(
            ends.enter_context(progress(open_source(source, about["selection"]).count, quiet))
        )
        ended = record_in_parts(
            source,
            settings,
            folder,
            PromptSet(given.boxes, given.masks, given.points),
            length=length,
            workers=workers or _processors(),
            selection=about["selection"],
            command=about["command"],
            overwrite=about["overwrite"],
            resume=about["resume"],
            listener=listener,
        )
    if quiet:
        return
    for one in ended.folders:
        print_summary(one)
    if len(ended.folders) > 1:
        typer.echo(
            f"The {ended.parts} parts could not be joined: {ended.reason}. Each is a run of its own: "
            f"{', '.join(map(str, ended.folders))}.",
            err=True,
        )
    elif ended.reason:
        typer.echo(f"Tracked as one part: {ended.reason}.", err=True)


def _check(given: Given, about: dict[str, Any], workers: int | None, view: bool, fps: float | None) -> None:
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: there has to be one worker at least.")
    if len(given) > 1:
        raise InputError("--split tracks one object; give one, or leave out --split.")
    for option, value in {
        "--start-frame": about["start_frame"] is not None,
        "--correct": bool(about["corrections"]),
        "--view": view,
        "--fps": fps is not None,
    }.items():
        if value:
            raise InputError(f"{option} and --split do not go together; leave out one of them.")


def _processors() -> int:
    import os

    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _to_be_resumed(folder: Path) -> Iterator[None]:
    """Whatever stops it, it says how to go on."""
    from tracking3d.splitting.plan import PARTS

    try:
        yield
    except BaseException as error:
        if (folder / PARTS).is_dir():
            error.add_note(
                f"What was finished is kept in {folder}; the same command with --resume goes on from there."
            )
        raise
