"""``tracking3d evaluate``: score a run against a clip with known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug


def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    truth: Annotated[Path, typer.Option(metavar="CLIP", help="Clip with frames/, masks/ and poses.json.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Score the run in RUN against the clip in CLIP."""
    import json
    from dataclasses import asdict

    from tracking3d.cli.tables import print_table
    from tracking3d.evaluation.score import format_scores, score_run

    scores = score_run(run, truth)
    if as_json:
        typer.echo(json.dumps(asdict(scores), indent=2))
    else:
        print_table(format_scores(scores))
