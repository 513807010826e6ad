"""``tracking3d correct``: prompt the object again in a frame of an existing run."""

from __future__ import annotations

from contextlib import ExitStack
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, RunOrParent, Video
from tracking3d.cli.options.output import Report
from tracking3d.cli.options.prompt import BoxFormat


def correct(
    run: RunOrParent,
    corrections: Annotated[
        list[str],
        typer.Argument(
            metavar="FRAME:BOX|MASK|POINTS...",
            help="Prompt in a frame: X,Y,W,H, a mask file or 'X,Y+ X,Y-'. FRAME@OBJECT if there are several objects.",
        ),
    ],
    box_format: BoxFormat = None,
    source: Video = None,
    report: Report = True,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Correct a run: re-compute all that depends on the corrected frames, with the run's own settings.

    The work is done in a copy, which replaces the run when it is finished. If the correction is stopped, the same
    command continues it.
    """
    import logging

    from tracking3d.trackers.prompts.boxes import check_box_format
    from tracking3d.trackers.prompts.corrections import parse_correction

    written = check_box_format(box_format or "xywh")
    parsed = [parse_correction(text, written) for text in corrections]
    from tracking3d.results.layout import CORRECTING, RUN, check_run_folder, has_state, runs_in

    for folder in runs_in(run):
        check_run_folder(folder)
    from tracking3d.cli.progress import load_with_progress, plan_run, show_progress
    from tracking3d.cli.report import report_at_end
    from tracking3d.cli.summary import print_summary

    load_with_progress("tracking3d.pipeline.correct", quiet, kernels=True)
    from tracking3d.pipeline.correct import (
        check_corrections,
        correct_run,
        object_folders_of,
        replaced_by_correction,
    )
    from tracking3d.results.run_reader import RunReader

    if quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    by_folder = object_folders_of(run, parsed)
    for folder, theirs in by_folder.items():
        check_corrections(folder, theirs)
        for sentence in replaced_by_correction(folder, report) if not quiet else ():
            typer.echo(sentence, err=True)
    for folder, theirs in by_folder.items():
        earlier = RunReader(folder)
        first = min(correction.frame for correction in theirs)
        kept = sum(record.index < first for record in earlier.frames)
        plan = plan_run(earlier.config, len(earlier.frames), report=report, kept=kept)
        with ExitStack() as ends:
            shown = ends.enter_context(show_progress(quiet, plan))
            reporting = ends.enter_context(report_at_end([folder] if report else []))
            listener = reporting(shown.show_frame)
            try:
                correct_run(folder, theirs, source=source, listener=listener)
            except BaseException as error:
                stage = folder / CORRECTING
                if (stage / RUN).is_file():
                    then = "continues the correction" if has_state(stage) else "tries again"
                    error.add_note(f"The run {folder} is unchanged; the same command {then}.")
                raise
        if not quiet:
            print_summary(folder)
