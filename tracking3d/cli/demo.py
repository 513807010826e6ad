"""``tracking3d demo``: the whole pipeline on a synthetic clip with exact truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, configure


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for the clip, the run and the summary.")
    ] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the clip and the run.")] = 0,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Make a short synthetic clip with exact truth, track its object with csrt and rgb, and score the answer.

    Writes DIR/clip, DIR/run and DIR/summary.json.
    """
    import json

    from tracking3d.cli.progress import print_summary, progress
    from tracking3d.cli.report import reported
    from tracking3d.cli.tables import print_figures
    from tracking3d.datasets.clip import read_truth
    from tracking3d.evaluation.score import score_run
    from tracking3d.open_tracking import request_tracking
    from tracking3d.prompts import PromptSet
    from tracking3d.recording import RecordOptions, record_tracking
    from tracking3d.results.files import write_atomic
    from tracking3d.results.layout import REPORT
    from tracking3d.synthesis.convex_clips import make_demo_clip
    from tracking3d.video import open_source

    settings = configure(None, None, None, tracker="csrt", features="rgb", runtime={"seed": seed})
    clip, folder = make_demo_clip(out / "clip", seed=seed), out / "run"
    source = open_source(clip / "frames")
    box = read_truth(clip).box
    options = RecordOptions(f"tracking3d demo --seed {seed}", overwrite=True)
    request = request_tracking(source, settings, PromptSet.of_one(box))
    with reported([folder]) as told, progress(source.count, quiet) as listener:
        record_tracking(request, folder, options, told(listener))

    scores = score_run(folder, clip)
    summary = {
        "iou_initial": scores.iou_initial_mean,
        "iou": scores.iou_mean,
        "rotation_error_mean_deg": scores.rotation_error_mean_deg,
        "rotation_error_median_deg": scores.rotation_error_median_deg,
        "seconds_per_frame": scores.seconds_per_frame,
    }
    write_atomic(out / "summary.json", json.dumps(summary, indent=2).encode() + b"\n")
    if not quiet:
        print_summary(folder)
        print_figures(str(out / "summary.json"), summary)
        typer.echo(
            f"Open {folder / REPORT} in a browser: the frames, the model to turn, and what to doubt.\n"
            "Your own video: tracking3d pick VIDEO, or tracking3d run VIDEO --box X,Y,WIDTH,HEIGHT --out runs/mine"
        )
