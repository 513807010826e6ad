"""``tracking3d correct``: say what the object is in a frame of a run that is there."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Quiet


def correct(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Run folder, or the folder with those of several objects.")
    ],
    corrections: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAME:BOX|MASK|POINTS...",
            help="What the object is in a frame: X,Y,W,H, a mask file or 'X,Y+ X,Y-'; FRAME@OBJECT of several.",
        ),
    ],
    source: Annotated[
        str | None,
        typer.Option(metavar="VIDEO", help="The video, where it is not where the run found it."),
    ] = None,
    report: Annotated[
        bool,
        typer.Option(
            "--report/--no-report", help="Write report.html and turntable.mp4 again.", show_default=False
        ),
    ] = True,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Correct a run: what depends on the corrected frame is computed again, with the run's own settings.

    It is done in a copy; the run stays as it is until that is finished. A correction that was stopped goes on when the
    same command is given again.
    """
    import logging

    from tracking3d.cli.progress import print_summary, progress
    from tracking3d.cli.report import report_progress
    from tracking3d.pipeline.correct import correct_run, object_folders_of
    from tracking3d.prompts.corrections import parse_correction
    from tracking3d.results.layout import CORRECTING, RUN, has_state
    from tracking3d.results.run_reader import RunReader

    if quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    by_folder = object_folders_of(run, [parse_correction(text) for text in corrections])
    for folder, theirs in by_folder.items():
        count = len(RunReader(folder).frames)
        with ExitStack() as ends:
            reporting = ends.enter_context(report_progress([folder] if report else []))
            listener = reporting(ends.enter_context(progress(count, quiet, 1)))
            try:
                correct_run(folder, theirs, source=source, listener=listener)
            except BaseException as error:
                stage = folder / CORRECTING
                if (stage / RUN).is_file():
                    then = "goes on with the correction" if has_state(stage) else "tries again"
                    error.add_note(f"The run {folder} is as it was; the same command {then}.")
                raise
        if not quiet:
            print_summary(folder)
