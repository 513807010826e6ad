"""``tracking3d demo``: the whole pipeline on a synthetic clip with exact ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug, Quiet, configure
from tracking3d.cli.options.general import OUTPUT


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

    from tracking3d.cli.progress import load_with_progress, plan_run, show_progress
    from tracking3d.cli.report import report_at_end
    from tracking3d.cli.summary import print_summary
    from tracking3d.cli.tables import print_figures

    load_with_progress("tracking3d.pipeline.record", quiet, kernels=True)
    from tracking3d.pipeline.open_tracking import request_tracking
    from tracking3d.pipeline.record import RecordOptions, record_tracking
    from tracking3d.results.files import write_atomic
    from tracking3d.results.layout import REPORT
    from tracking3d.testing.synthesis.convex_clips import make_demo_clip
    from tracking3d.trackers.prompts.prompt import PromptSet
    from tracking3d.video import open_source

    settings = configure(None, None, None, tracker="csrt", features="rgb", runtime={"seed": seed})
    with show_progress(quiet) as display:
        clip, folder = make_demo_clip(out / "clip", seed=seed), out / "run"
        source = open_source(clip / "frames")
        display.expect(plan_run(settings.model_dump(), source.count))
        options = RecordOptions(f"tracking3d demo --seed {seed}", overwrite=True)
        x, y, w, h = json.loads((clip / "init.json").read_text(encoding="utf-8"))["bbox_xywh"]
        box = float(x), float(y), float(w), float(h)
        request = request_tracking(source, settings, PromptSet.of_one(box))
        with report_at_end([folder]) as reporting:
            record_tracking(request, folder, options, reporting(display.show_frame))
        summary = _score(folder, clip)
    write_atomic(out / "summary.json", json.dumps(summary, indent=2).encode() + b"\n")
    if not quiet:
        print_summary(folder)
        print_figures(str(out / "summary.json"), summary)
        typer.echo(
            f"Open {folder / REPORT} in a browser to see the frames, the 3D model, and which frames are uncertain.\n"
            "To track your own video: tracking3d pick VIDEO, or tracking3d run VIDEO --box X,Y,WIDTH,HEIGHT"
        )


def _score(run_folder: Path, clip: Path) -> dict[str, float | None]:
    """The figures of the demo: IoU without the frame that was prompted, rotations aligned by one rotation."""
    import json

    import numpy as np

    from tracking3d.frames import mask_iou_or_none
    from tracking3d.geometry.alignment import rotation_alignment, transposed_product
    from tracking3d.results import layout
    from tracking3d.results.description import time_per_frame
    from tracking3d.results.files import read_mask
    from tracking3d.results.run_reader import RunReader

    run = RunReader(run_folder)
    truth = json.loads((clip / "poses.json").read_text(encoding="utf-8"))["frames"]
    ious, rotations = [], []
    for record in run.frames:
        name = f"{record.index:06d}"
        true = read_mask(clip / "masks" / f"{name}.png")
        files = layout.initial_mask_path(run_folder, record.index), run.mask_path(record.index)
        assert true is not None
        if record is not run.frames[0]:
            ious.append([mask_iou_or_none(true, read_mask(file)) or 0.0 for file in files])
        rotations.append((record.T_cam_obj[:3, :3], truth[name]["R"]))
    R_est, R_true = np.array(rotations, dtype=np.float64).swapaxes(0, 1)
    A = rotation_alignment(R_est, R_true)
    errors = np.degrees(transposed_product(R_est @ A, R_true).magnitude())
    initial, final = (float(column.mean()) for column in np.array(ious).T)
    return {
        "iou_initial": initial,
        "iou": final,
        "rotation_error_mean_deg": float(errors.mean()),
        "rotation_error_median_deg": float(np.median(errors)),
        "seconds_per_frame": time_per_frame(run.description)[0],
    }
