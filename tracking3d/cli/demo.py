"""``tracking3d demo``: the whole pipeline on a synthetic clip with exact ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, configure
from tracking3d.cli.options.panels import OUTPUT


def demo(
    out: Annotated[
        Path,
        typer.Option(
            metavar="DIR", help="Folder for the clip, the run and the summary.", rich_help_panel=OUTPUT
        ),
    ] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Random seed of the clip and the run.")] = 0,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Render a short synthetic clip with exact ground truth, track its object with csrt and rgb, and score the run.

    Writes DIR/clip, DIR/run and DIR/summary.json.
    """
    import json

    from tracking3d.cli.plans import plan_run
    from tracking3d.cli.progress import load_with_progress, show_progress
    from tracking3d.cli.report import report_at_end
    from tracking3d.cli.summary import print_summary
    from tracking3d.cli.tables import print_figures

    load_with_progress("tracking3d.pipeline.record", quiet, kernels=True)
    from tracking3d.datasets.clip import read_truth
    from tracking3d.evaluation.score import score_run
    from tracking3d.pipeline.open_tracking import request_tracking
    from tracking3d.pipeline.record import RecordOptions, record_tracking
    from tracking3d.prompts.prompt import PromptSet
    from tracking3d.results.files import write_atomic
    from tracking3d.results.layout import REPORT
    from tracking3d.synthesis.convex_clips import make_demo_clip
    from tracking3d.video import open_source

    settings = configure(None, None, None, tracker="csrt", features="rgb", runtime={"seed": seed})
    with show_progress(quiet) as display:
        clip, folder = make_demo_clip(out / "clip", seed=seed), out / "run"
        source = open_source(clip / "frames")
        display.expect(plan_run(settings.model_dump(), source.count))
        options = RecordOptions(f"tracking3d demo --seed {seed}", overwrite=True)
        request = request_tracking(source, settings, PromptSet.of_one(read_truth(clip).box))
        with report_at_end([folder]) as reporting:
            record_tracking(request, folder, options, reporting(display.show_frame))
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
            f"Open {folder / REPORT} in a browser to see the frames, the 3D model, and which frames are uncertain.\n"
            "To track your own video: tracking3d pick VIDEO, or tracking3d run VIDEO --box X,Y,WIDTH,HEIGHT"
        )
