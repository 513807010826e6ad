"""``tracking3d evaluate ANSWERS --truth CLIP``: score a run, or the results of another system."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from tracking3d.cli.options import AsJson, Debug
from tracking3d.errors import InputError
from tracking3d_bench.cli.evaluate.options import Truth


class EstimateKind(StrEnum):
    """Which estimates of a run are scored."""

    final = "final"
    causal = "causal"


def score_answers(
    results: Annotated[
        Path,
        typer.Argument(
            metavar="ANSWERS",
            help="Estimates: run folder, mask folder, BOP CSV, TUM trajectory, TAP-Vid pickle or COLMAP model.",
        ),
    ],
    truth: Truth,
    form: Annotated[
        str | None,
        typer.Option("--format", metavar="NAME", help="Format of the estimates; detected if left out."),
    ] = None,
    options: Annotated[
        list[str] | None,
        typer.Option(
            "--option", metavar="KEY=VALUE", help="Option of that format, such as of=camera; may be repeated."
        ),
    ] = None,
    answers: Annotated[
        EstimateKind,
        typer.Option(help="Score the estimates after the final refinement, or the causal ones before it."),
    ] = EstimateKind.final,
    offset: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Offset of a run: its frame i is frame i + N of the clip; default 0.",
            show_default=False,
        ),
    ] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score ANSWERS against the ground truth in CLIP."""
    import json
    from dataclasses import asdict

    if not truth.is_dir():
        raise InputError(f"There is no clip folder {truth}; give the folder which holds frames/ and masks/.")
    settings = _read_options(options)
    from tracking3d.cli.tables import print_table
    from tracking3d.results.run_reader import RunReader
    from tracking3d_bench.datasets.clip import read_truth
    from tracking3d_bench.evaluation.score import score
    from tracking3d_bench.evaluation.score_table import format_scores
    from tracking3d_bench.evaluation.sources import A_RUN_FOLDER, open_answers

    known = read_truth(truth)
    refined = answers is EstimateKind.final
    given, kind = open_answers(results, known, form, refined=refined, offset=offset, **settings)
    if form is None and not as_json:
        typer.echo(f"{results} is read as {kind}.", err=True)
    if not as_json:
        typer.echo(f"{given.matched(len(known.frames))}.", err=True)
    if kind == A_RUN_FOLDER and (warning := RunReader(results).not_finished):
        typer.echo(warning, err=True)
    scores = score(given, known)
    if as_json:
        typer.echo(json.dumps(asdict(scores), indent=2))
    else:
        print_table(format_scores(scores))


def _read_options(items: list[str] | None) -> dict[str, Any]:
    """Read ``KEY=VALUE`` items; a value is YAML."""
    from tracking3d.config.loading import parse_yaml

    pairs = [item.partition("=") for item in items or ()]
    for key, equals, value in pairs:
        if not key.isidentifier() or not equals:
            raise InputError(f"--option {key}{equals}{value} is not KEY=VALUE; write it like of=camera.")
    return {key: parse_yaml(value, f"--option {key}={value}") for key, _, value in pairs}
