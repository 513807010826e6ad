"""``tracking3d evaluate peer``: run another system on the same clip, and score it by the same measures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import AsJson, Debug
from tracking3d.errors import InputError
from tracking3d_bench.cli.evaluate.options import Truth

PEERS = ("colmap",)


def peer(
    system: Annotated[str, typer.Argument(metavar="SYSTEM", help="Name of the system: colmap.")],
    truth: Truth,
    model: Annotated[
        Path | None,
        typer.Argument(
            metavar="[MODEL]",
            help="The system's model of the clip, as text or binary; it is run on the clip if left out.",
            show_default=False,
        ),
    ] = None,
    runs: Annotated[
        list[Path] | None,
        typer.Option("--beside", metavar="RUN", help="Run folder of the same views; may be repeated."),
    ] = None,
    frames: Annotated[
        str | None, typer.Option(metavar="START:STOP:STEP", help="Views of the clip; all if left out.")
    ] = None,
    step: Annotated[
        float | None,
        typer.Option(
            metavar="DEGREES",
            help="The clip is a turntable with equal steps and without poses; what is in front moves to the right.",
        ),
    ] = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score what another system estimates on the clip in CLIP; frames without a pose count as lost.

    Without MODEL, COLMAP runs on the clip's frames and masks, with its own thresholds and with lower ones, which suit a
    small object; the table has the views that it and the runs beside it place within 10 degrees.
    """
    if system not in PEERS:
        raise InputError(f"The system '{system}' is unknown; choose one of {', '.join(PEERS)}.")
    if model is not None:
        from tracking3d_bench.cli.evaluate.answers import score_answers

        if runs or frames or step:
            raise InputError("--beside, --frames and --step are for systems that are run; leave out MODEL.")
        score_answers(model, truth, form=system, as_json=as_json, debug=debug)
        return
    import json
    from dataclasses import asdict

    from rich.table import Table

    from tracking3d.cli.tables import format_value, print_table
    from tracking3d.video.source import parse_selection, within
    from tracking3d_bench.benchmark.peer import run_colmap, score_views
    from tracking3d_bench.datasets.clip import read_truth
    from tracking3d_bench.datasets.run_answers import answers_of_run

    known = read_truth(truth)
    asked = within(parse_selection(frames), len(known.frames))
    rows = []
    for lowered in (False, True):
        answers, seconds = run_colmap(known, asked, lowered=lowered)
        name = f"{system}, {'lower' if lowered else 'its own'} thresholds"
        rows.append(score_views(name, answers, known, step, seconds))
    rows += [score_views(str(run), answers_of_run(run, known), known, step, None) for run in runs or ()]
    figures = [asdict(row) for row in rows]
    if as_json:
        typer.echo(json.dumps(figures, indent=2))
        return
    table = Table(*(name.replace("_", " ") for name in figures[0]))
    for one in figures:
        table.add_row(*map(format_value, one.values()))
    print_table(table)
