"""``tracking3d bench points``: how well points are followed, beside methods without a model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Quiet


def points(
    folder: Annotated[
        Path,
        typer.Argument(
            metavar="DIR", help="What --out of `evaluate suite` was: its finished runs are measured."
        ),
    ],
    beside: Annotated[
        bool,
        typer.Option(
            "--beside/--alone", help="Also the mesh alone, chained Lucas-Kanade, chained dense flow."
        ),
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Follow the true points of finished runs: TAP-Vid's delta_avg, OA and AJ, and how well uncertainty is known."""
    import json

    import cv2
    import torch

    from tracking3d.cli.tables import print_table
    from tracking3d_bench.benchmark.point_runs import finished_jobs, measure_run
    from tracking3d_bench.benchmark.point_table import format_points, point_report
    from tracking3d_bench.datasets.run_answers import is_refined

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    measured = []
    for job, run in finished_jobs(folder):
        for refined in (True, False) if is_refined(run) else (False,):
            measured.append(measure_run(job, run, refined, beside))
            if not (quiet or as_json):
                row = measured[-1].rows["corrected"]
                said = "unknown" if row.delta is None else f"{row.delta:.3f}"
                answers = "refined" if refined else "causal"
                typer.echo(f"{job.sequence} ({job.variant.masks}, {answers}): delta_avg {said}", err=True)
    report = point_report(measured)
    if as_json:
        typer.echo(json.dumps(report))
    else:
        print_table(format_points(report))
