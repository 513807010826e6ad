"""What ``run`` and ``pick`` end in: the object is tracked, shown while it goes on, and summed up."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig


@dataclass(frozen=True)
class Given:
    """What the objects are: one of these for each, or nothing where the mask tracker knows."""

    boxes: Sequence[Any] = ()
    masks: Sequence[Any] = ()
    points: Sequence[Any] = ()

    def __len__(self) -> int:
        return len(self.boxes) + len(self.masks) + len(self.points)


def track(
    source: str,
    settings: PipelineConfig,
    folder: Path,
    given: Given,
    about: dict[str, Any],
    *,
    fps: float | None = None,
    quiet: bool = False,
    report: bool = True,
    view: bool = False,
    host: str | None = None,
) -> None:
    """Track, show how it goes, and print what came of it.

    Args:
        source: What SOURCE is.
        settings: The configuration.
        folder: The run folder.
        given: What the objects are.
        about: Further arguments of `tracking3d.recording.record`, ``selection`` among them.
        fps: Images per second of a source that has no times of its own.
        quiet: Print nothing.
        report: Write a report at the end.
        view: Show the run in the browser.
        host: Where that is served.
    """
    from tracking3d.cli.progress import print_summary, progress
    from tracking3d.cli.report import reported
    from tracking3d.cli.view import watched
    from tracking3d.open_tracking import request_tracking
    from tracking3d.prompts import PromptSet
    from tracking3d.recording import RecordOptions, record_tracking
    from tracking3d.results.layout import object_folders
    from tracking3d.results.run_reader import is_finished
    from tracking3d.video import open_source

    opened = open_source(source, about.get("selection"), fps)
    if quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    objects = max(len(given), 1)
    folders = object_folders(folder, objects) if objects > 1 else [folder]
    finished = {one: _written(one) for one in folders if about.get("resume") and is_finished(one)}
    with ExitStack() as ends:
        ends.enter_context(resumable(folders))
        reporting = ends.enter_context(reported(folders if report else []))
        listener = reporting(ends.enter_context(progress(opened.count, quiet, objects)))
        if view:
            opened, listener = ends.enter_context(watched(opened, folder, listener, host, quiet))
        about = dict(about)
        start, corrections = about.pop("start_frame", None), about.pop("corrections", ())
        skip_damaged = about.pop("skip_damaged", False)
        prompts = PromptSet(given.boxes, given.masks, given.points, start, as_lists=objects > 1)
        request = request_tracking(opened, settings, prompts, corrections, skip_damaged)
        record_tracking(request, folder, RecordOptions(**about), listener)
    for one in () if quiet else folders:
        if one in finished and finished[one] == _written(one):
            typer.echo(f"The run {one} is finished already; there is nothing to resume.")
        else:
            print_summary(one)


def a_person_is_there() -> bool:
    """Whether the program was called from a terminal, not by a script."""
    return sys.stdin is not None and sys.stdin.isatty() and sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def resumable(folders: list[Path]) -> Iterator[None]:
    """Whatever stops a run, it says how to go on, where that is possible."""
    from tracking3d.results.layout import CORRECTING, has_state

    try:
        yield
    except BaseException as error:
        if any(has_state(folder) or has_state(folder / CORRECTING) for folder in folders):
            error.add_note("The same command with --resume goes on from there.")
        raise


def default_folder(source: str) -> Path:
    """``runs/<name>`` after the file, the folder of images, the camera, or the end of an address."""
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
    """When the description of a run was written last."""
    from tracking3d.results.layout import RUN

    return (folder / RUN).stat().st_mtime_ns
