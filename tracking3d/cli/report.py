"""``tracking3d report``: write the report of a run, as every run does at its end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from tracking3d.cli.options import Debug, Quiet, RunOrParent
from tracking3d.errors import Tracking3dError

if TYPE_CHECKING:
    from tracking3d.frames import SkippedFrame
    from tracking3d.pipeline.passes import Listener
    from tracking3d.results.records import FrameRecord


def report(
    run: RunOrParent,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write RUN/report.html, a single file that any browser shows, and RUN/turntable.mp4.

    If there are several objects, each gets its own report, and RUN/index.html links to them.
    """
    from tracking3d.results.layout import check_run_folder, runs_in

    for folder in runs_in(run):
        check_run_folder(folder)
    from tracking3d.cli.progress import load_with_progress, plan_report, show_progress

    load_with_progress("tracking3d.ui.report.several", quiet, kernels=True)
    from tracking3d.results.run_reader import RunReader
    from tracking3d.ui.report.several import write_reports

    folders = runs_in(run)
    with show_progress(quiet) as display:
        display.expect([stage for folder in folders for stage in plan_report(len(RunReader(folder).frames))])
        written = write_reports(folders)
    if not quiet:
        for path in written:
            typer.echo(path)


@contextmanager
def report_at_end(folders: Sequence[Path]) -> Iterator[Callable[[Listener], Listener]]:
    """Write the reports of runs when the block ends, however it ends, if at least one frame was tracked.

    If the block ends without an error, finished runs that have no report, or whose files have changed since, get one
    too. If a report cannot be written, that is printed; it does not change how the run ended.

    Args:
        folders: The run folders; none means no reports.

    Yields:
        A function that wraps a listener, to note that there is something to report.

    Raises:
        KeyboardInterrupt: If the writing of the report was interrupted.
    """
    from tracking3d.results.run_notes import timed_pass
    from tracking3d.results.run_writer import times_written

    begun = False

    def noting(listener: Listener) -> Listener:
        def note(frame: FrameRecord | SkippedFrame) -> None:
            nonlocal begun
            begun = True
            listener(frame)

        return note

    before = {folder: times_written(folder) for folder in folders}
    try:
        yield noting
    except BaseException:
        if begun and folders:
            with suppress(KeyboardInterrupt):  # the first error is raised
                _write(folders)
        raise
    if folders and (begun or any(_is_due(folder, before[folder]) for folder in folders)):
        with ExitStack() as timed:
            for folder in folders if begun else ():
                timed.enter_context(timed_pass(folder, "report"))
            _write(folders)


def _is_due(folder: Path, before: tuple[int, ...]) -> bool:
    """Whether a finished run needs a report: it has none, or its files are not as they were."""
    from tracking3d.results.run_reader import is_finished
    from tracking3d.results.run_writer import lacks_report, times_written

    return is_finished(folder) and (lacks_report(folder) or times_written(folder) != before)


def _write(folders: Sequence[Path]) -> None:
    try:
        from tracking3d.results.layout import RUN
        from tracking3d.ui.report.several import write_reports

        write_reports([folder for folder in folders if (folder / RUN).is_file()])
    except Exception as error:
        sentence = error.at_the_command_line if isinstance(error, Tracking3dError) else f"{error}."
        typer.echo(
            f"The report could not be written: {' '.join(sentence.split())} Try again with `tracking3d report`.",
            err=True,
        )
    except KeyboardInterrupt:
        typer.echo("The report was interrupted. Try again with `tracking3d report`.", err=True)
        raise
