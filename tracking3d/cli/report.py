"""``tracking3d report``: pages about runs; and the report that every run ends with."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import Debug
from tracking3d.errors import Tracking3dError

if TYPE_CHECKING:
    from tracking3d.frames import SkippedFrame
    from tracking3d.pipeline.passes import Listener
    from tracking3d.results.records import FrameRecord


def report(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder, or the folder with those of several objects.")
    ],
    debug: Debug = False,
) -> None:
    """Write RUN/report.html, one file to look at the run in any browser, and RUN/turntable.mp4.

    Of several objects each gets a report, and RUN/index.html links to them.
    """
    from tracking3d.report.several import write_reports
    from tracking3d.results.layout import runs_in

    for path in write_reports(runs_in(run)):
        typer.echo(path)


@contextmanager
def report_progress(folders: Sequence[Path]) -> Iterator[Callable[[Listener], Listener]]:
    """Write the reports of runs when what is within ends, in whatever way, if it got as far as a frame.

    That a report cannot be written is said, and changes nothing about how the run ended.

    Args:
        folders: The run folders; none leaves reports out.

    Yields:
        What makes of a listener one that also notes that there is something to report.
    """
    begun = False

    def noting(listener: Listener) -> Listener:
        def told(frame: FrameRecord | SkippedFrame) -> None:
            nonlocal begun
            begun = True
            listener(frame)

        return told

    try:
        yield noting
    finally:
        if begun and folders:
            _write(folders)


def _write(folders: Sequence[Path]) -> None:
    try:
        from tracking3d.report.several import write_reports
        from tracking3d.results.layout import RUN

        write_reports([folder for folder in folders if (folder / RUN).is_file()])
    except Exception as error:
        sentence = error.at_the_command_line if isinstance(error, Tracking3dError) else f"{error}."
        typer.echo(
            f"The report could not be written: {' '.join(sentence.split())} `tracking3d report` tries again.",
            err=True,
        )
    except KeyboardInterrupt:
        typer.echo("The report was not finished: interrupted. `tracking3d report` tries again.", err=True)
