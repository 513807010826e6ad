"""What ``run`` and ``pick`` have in common: track the object, show the progress, and print a summary."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.video.source import FrameSource


@dataclass(frozen=True)
class Given:
    """What the objects are: one prompt for each, or none if the mask tracker or a known object replaces it."""

    boxes: Sequence[Any] = ()
    masks: Sequence[Any] = ()
    points: Sequence[Any] = ()

    def __len__(self) -> int:
        return len(self.boxes) + len(self.masks) + len(self.points)


@dataclass(frozen=True)
class RunDisplay:
    """What a run shows while it is tracked, and at its end.

    Attributes:
        quiet: Print errors only.
        report: Write a report at the end.
        view: Show the run in the browser.
        host: Address of this machine that the page is served on; this machine only if None.
    """

    quiet: bool = False
    report: bool = True
    view: bool = False
    host: str | None = None


def track(
    source: str,
    settings: PipelineConfig,
    folder: Path,
    given: Given,
    arguments: dict[str, Any],
    display: RunDisplay,
    *,
    fps: float | None = None,
) -> None:
    """Track, show the progress, and print a summary.

    Args:
        source: The command's argument SOURCE.
        settings: The configuration.
        folder: The run folder.
        given: What the objects are.
        arguments: Further arguments of `tracking3d.recording.record`, ``selection`` among them.
        display: What is shown.
        fps: Frame rate of a source that has no timestamps.
    """
    from tracking3d.cli.progress import progress
    from tracking3d.cli.report import reported
    from tracking3d.cli.view import watched
    from tracking3d.results.layout import object_folders
    from tracking3d.results.run_reader import is_finished
    from tracking3d.video import open_source

    opened = open_source(source, arguments.get("selection"), fps)
    if display.quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    objects = max(len(given), 1)
    folders = object_folders(folder, objects) if objects > 1 else [folder]
    finished = {one: _written(one) for one in folders if arguments.get("resume") and is_finished(one)}
    with ExitStack() as ends:
        ends.enter_context(resumable(folders))
        reporting = ends.enter_context(reported(folders if display.report else []))
        listener = reporting(ends.enter_context(progress(opened.count, display.quiet, objects)))
        if display.view:
            opened, listener = ends.enter_context(
                watched(opened, folder, listener, display.host, display.quiet)
            )
        _record(opened, settings, folder, given, {**arguments, "listener": listener})
    if not display.quiet:
        _print_summaries(folders, finished)


def _record(
    source: FrameSource, settings: PipelineConfig, folder: Path, given: Given, arguments: dict[str, Any]
) -> None:
    """Record one object in ``folder``, or several in folders of their own."""
    from tracking3d.recording import record, record_objects

    if len(given) > 1:
        several: dict[str, Any] = {"boxes": given.boxes, "masks": given.masks, "points": given.points}
        record_objects(source, settings, folder, **several, **arguments)
    else:
        box, mask, points = (next(iter(one), None) for one in (given.boxes, given.masks, given.points))
        record(source, settings, folder, box=box, mask=mask, points=points, **arguments)


def _print_summaries(folders: Sequence[Path], finished: Mapping[Path, int]) -> None:
    """Print the closing table of each run that was not finished before.

    Args:
        folders: The run folders.
        finished: When the runs that had been finished before were written.
    """
    from tracking3d.cli.progress import print_summary

    for folder in folders:
        if folder in finished and finished[folder] == _written(folder):
            typer.echo(f"The run {folder} is already finished; there is nothing to resume.")
        else:
            print_summary(folder)


def a_person_is_there() -> bool:
    """Whether the program was started from a terminal, not by a script."""
    return sys.stdin is not None and sys.stdin.isatty() and sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def resumable(folders: list[Path]) -> Iterator[None]:
    """If a run is stopped, say how to continue it, if it can be continued."""
    from tracking3d.results.layout import CORRECTING, has_state

    try:
        yield
    except BaseException as error:
        if any(has_state(folder) or has_state(folder / CORRECTING) for folder in folders):
            error.add_note("To continue from there, repeat the command with --resume.")
        raise


def default_folder(source: str) -> Path:
    """``runs/<name>``, named after the file, the image folder, the camera, or the last part of an address."""
    from tracking3d.video.stream import SCHEMES, scheme_of, without_password

    if source.isdigit() and not Path(source).exists():
        return Path("runs", f"camera_{source}")
    if not Path(source).exists() and (scheme_of(source) in SCHEMES):
        end = Path(without_password(source).partition("//")[2].partition("?")[0]).stem
        return Path("runs", re.sub("[^A-Za-z0-9_-]+", "_", end).strip("_") or "stream")
    path = Path(source).expanduser().absolute()
    if any(sign in path.name for sign in "*?["):
        path = path.parent
    if path.name in ("frames", "images"):
        path = path.parent
    return Path("runs", path.stem if path.is_file() else path.name)


def _written(folder: Path) -> int:
    """When the description of a run was last written."""
    from tracking3d.results.layout import RUN

    return (folder / RUN).stat().st_mtime_ns
