"""What ``run`` and ``pick`` have in common: track the object, show the progress, and print a summary."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig
    from tracking3d.pipeline.record import RecordOptions
    from tracking3d.trackers.prompts.corrections import Correction
    from tracking3d.trackers.prompts.prompt import PromptSet
    from tracking3d.ui.picker.server import PageProgress, Picker


@dataclass(frozen=True)
class RunRequest:
    """What a run tracks, and the folder it writes."""

    source: str  # the command's argument SOURCE
    config: PipelineConfig  # the configuration
    folder: Path  # the run folder
    prompts: PromptSet  # the objects; none if the mask tracker or a known object replaces the prompt
    options: RecordOptions  # how the run is recorded, selection of the frames included
    corrections: Sequence[Correction] = ()  # prompts in later frames
    # if the first frame cannot be decoded, apply the prompts to the first frame that can
    skip_damaged: bool = False
    fps: float | None = None  # frame rate of a source that has no timestamps


@dataclass(frozen=True)
class RunDisplay:
    """What a run shows while it is tracked, and at its end."""

    quiet: bool = False  # print errors only
    report: bool = True  # write a report at the end
    view: bool = False  # show the run in the browser
    host: str | None = None  # address of this machine that the page is served on; this machine only if None
    # the page on which the object was picked, which shows the run then; None without it
    page: Picker | None = None


def track(request: RunRequest, display: RunDisplay) -> None:
    """Track, show the progress, and print a summary."""
    from tracking3d.cli.progress import plan_run, show_progress
    from tracking3d.cli.report import report_at_end
    from tracking3d.cli.view import watch
    from tracking3d.pipeline.open_tracking import request_tracking
    from tracking3d.pipeline.record import record_tracking
    from tracking3d.results.layout import object_folders
    from tracking3d.results.run_reader import is_finished
    from tracking3d.results.run_writer import times_written
    from tracking3d.video import open_source

    folder, options, prompts = request.folder, request.options, request.prompts
    source = open_source(request.source, options.selection, request.fps)
    if display.quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    objects = max(len(prompts), 1)
    folders = object_folders(folder, objects) if objects > 1 else [folder]
    finished = {one: times_written(one) for one in folders if options.resume and is_finished(one)}
    with ExitStack() as ends:
        ends.enter_context(resumable(folders, options))
        plan = plan_run(request.config.model_dump(), source.count, objects, display.report)
        shown = ends.enter_context(show_progress(display.quiet, plan))
        reporting = ends.enter_context(report_at_end(folders if display.report else []))
        listener = reporting(shown.show_frame)
        if display.page is not None:
            ends.enter_context(_shown_on_page(display, folder, folders, shown.progress))
        if display.view:
            source, listener = ends.enter_context(
                watch(source, folder, listener, display.host, display.quiet)
            )
        tracking = request_tracking(
            source, request.config, prompts, request.corrections, request.skip_damaged
        )
        record_tracking(tracking, folder, options, listener)
    if not display.quiet:
        _print_summaries(folders, finished)


@contextmanager
def _shown_on_page(
    display: RunDisplay, folder: Path, folders: Sequence[Path], progress: Callable[[], PageProgress]
) -> Iterator[None]:
    """Within, the page shows how far the run is, and afterwards that it is finished."""
    from tracking3d.ui.picker.server import PageProgress, ShownRun

    page = display.page
    assert page is not None

    @cache
    def view() -> str:
        from tracking3d.ui.viewer.opening import open_viewer

        viewer = open_viewer([folder], page.access)
        page.ends.callback(viewer.close)
        return viewer.address

    page.run = run = ShownRun(folders, progress, view if find_spec("viser") else None)
    yield
    page.run = replace(run, progress=lambda: PageProgress(sentence="The run is finished."))


def _print_summaries(folders: Sequence[Path], finished: Mapping[Path, tuple[int, ...]]) -> None:
    """Print the closing table of each run that was not finished before.

    Args:
        folders: The run folders.
        finished: When the files of the runs that had been finished before were written.
    """
    from tracking3d.cli.summary import print_summary
    from tracking3d.results.run_writer import times_written

    for folder in folders:
        if finished.get(folder) == times_written(folder):
            typer.echo(f"The run {folder} is already finished; there is nothing to resume.")
        else:
            print_summary(folder)


def a_person_is_there() -> bool:
    """Whether the program was started from a terminal, not by a script."""
    return sys.stdin is not None and sys.stdin.isatty() and sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def resumable(folders: list[Path], options: RecordOptions) -> Iterator[None]:
    """If a run is stopped, say how to continue it, if it can be continued: by its command."""
    from tracking3d.errors import InputError
    from tracking3d.results.description import for_new_folder
    from tracking3d.results.layout import CORRECTING, has_state

    try:
        yield
    except BaseException as error:
        refused = options.resume and isinstance(error, InputError)  # it would be refused again
        if not refused and any(has_state(folder) or has_state(folder / CORRECTING) for folder in folders):
            error.add_note(f"To continue from there: {for_new_folder(options.command or '')} --resume")
        raise


def default_folder(source: str) -> Path:
    """``runs/<name>``, named after the file, the image folder, the camera, or the last part of an address."""
    from tracking3d.video.addresses import SCHEMES, scheme_of, without_password

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
