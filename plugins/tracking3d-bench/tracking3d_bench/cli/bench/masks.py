"""``tracking3d bench masks``: mask trackers by themselves."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quiet
from tracking3d.cli.options.general import Sequences
from tracking3d_bench.cli.evaluate.options import Data, Out

if TYPE_CHECKING:
    from tracking3d_bench.benchmark.mask_trackers import TrackerMeasurement


class Start(StrEnum):
    """What a tracker is given in the first frame."""

    box = "box"
    mask = "mask"


def masks(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="smoke, standard, hard, full (synthetic), real, the layout of a dataset, or a YAML file of one.",
        ),
    ],
    data: Data = None,
    tracker: Annotated[
        list[str] | None,
        typer.Option(
            "--tracker",
            metavar="NAME",
            help="Mask tracker; may be repeated. The configuration's if left out.",
        ),
    ] = None,
    sequences: Sequences = None,
    frames: Annotated[
        int | None, typer.Option(min=2, metavar="N", help="Only the first N frames of each sequence.")
    ] = None,
    start: Annotated[
        Start, typer.Option(help="Start from the first frame's box or its true mask.")
    ] = Start.box,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Switch off each cue of the tracker flow in turn, too.")
    ] = False,
    threads: Annotated[int, typer.Option(min=1, max=256, help="CPU threads of OpenCV.")] = 1,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    out: Out = Path("benchmark"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run mask trackers alone over a dataset: IoU, time a frame, and what their scores are worth.

    One after the other in one process. A tracker that fails on a sequence is a row with the reason.
    """
    import json

    from tracking3d.cli.options import configure
    from tracking3d_bench.benchmark.sequences import open_dataset
    from tracking3d_bench.cli.evaluate.progress import making_progress

    chosen = [
        configure(config, preset, overrides, tracker=None if one is None else {"name": one}).tracker
        for one in dict.fromkeys(tracker or (None,))
    ]
    with making_progress(quiet or as_json) as made:
        dataset = open_dataset(name, data, out, 1, made).only(sequences or [])
    import cv2

    from tracking3d.cli.tables import print_table
    from tracking3d_bench.benchmark.mask_table import format_masks, report
    from tracking3d_bench.benchmark.mask_trackers import Contestant, measure_trackers
    from tracking3d_bench.benchmark.mask_trackers import ablation as switched_off

    contestants = [Contestant.of(choice) for choice in chosen]
    if ablation:
        contestants = [one for contestant in contestants for one in switched_off(contestant)]
    cv2.setNumThreads(threads)
    silent = quiet or as_json
    heard = (lambda measured: None) if silent else _print_measured
    results = measure_trackers(contestants, dataset, start.value, frames, heard)
    if as_json:
        typer.echo(json.dumps(report(results, dataset, start.value)))
    elif not quiet:
        print_table(format_masks(results, dataset))
    if failed := [one for one in results if one.error]:
        for one in failed if silent else ():
            typer.echo(f"{one.sequence} ({one.tracker}) failed: {one.error}", err=True)
        raise typer.Exit(1)


def _print_measured(measured: TrackerMeasurement) -> None:
    """Print on the standard error how a tracker did on a sequence."""
    what = measured.error or f"IoU {measured.figures()['iou_mean']:.3f}"
    typer.echo(f"{measured.sequence} ({measured.tracker}): {what}", err=True)
