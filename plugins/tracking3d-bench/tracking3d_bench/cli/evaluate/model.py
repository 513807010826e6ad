"""``tracking3d evaluate model RUN...``: score the mesh of a run, on held-out frames and against the true shape."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from tracking3d.cli.options import AsJson, Debug
from tracking3d.cli.options.general import DATA
from tracking3d.errors import InputError

_COLUMNS = {
    "frames": ("frames", "{:d}"),
    "psnr": ("PSNR", "{:.2f} dB"),
    "ssim": ("SSIM", "{:.3f}"),
    "covered": ("covered", "{:.3f}"),
    "shape_f_score_seen": ("F 2 % seen", "{:.3f}"),
    "shape_f_score_fitted": ("F 2 % fitted", "{:.3f}"),
    "shape_f_score_fine_fitted": ("F 1 % fitted", "{:.3f}"),
    "shape_normals": ("normals", "{:.3f}"),
    "shape_genus_error": ("genus error", "{:d}"),
}


def score_models(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders.")],
    truth: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="CLIP",
            help="Clip with the true mesh; one for each run, in the same order.",
            rich_help_panel=DATA,
        ),
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(
            metavar="VIDEO",
            help="Path of the video, if it has moved since the run; one for each run, in the same order.",
            rich_help_panel=DATA,
        ),
    ] = None,
    largest: Annotated[
        int, typer.Option(min=64, max=8192, help="Maximum side of the texture image, in texels.")
    ] = 2048,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Score the meshes of runs: by rendering held-out frames, and against the true shape.

    Every eighth reliable frame is held out of the texture, as `tracking3d model --model fine` holds it out of the
    shape; only its pose is fitted. Nothing is written.
    """
    import json

    from tracking3d.results.layout import check_run_folder

    for run in runs:
        check_run_folder(run)
    from rich.markup import escape
    from rich.table import Table

    from tracking3d.cli.tables import print_table

    for name, given in (("--truth", truth), ("--source", source)):
        if given and len(given) != len(runs):
            raise InputError(
                f"{name} is given {len(given)} times for {len(runs)} runs; give it once for each, in the same order."
            )
    scores = {
        str(run): _scores(run, truth[n] if truth else None, source[n] if source else None, largest)
        for n, run in enumerate(runs)
    }
    if as_json:
        typer.echo(json.dumps(scores, indent=2))
        return
    known = [key for key in _COLUMNS if any(one.get(key) is not None for one in scores.values())]
    table = Table("run", *(_COLUMNS[key][0] for key in known))
    for name, one in scores.items():
        table.add_row(escape(name), *(_cell(key, one.get(key)) for key in known))
    print_table(table)


def _scores(run: Path, clip: Path | None, source: str | None, largest: int) -> dict[str, Any]:
    from dataclasses import asdict

    from tracking3d_bench.evaluation.held_out_frames import NothingHeldOutError, score_held_out_frames

    if clip is None:
        return asdict(score_held_out_frames(run, source, largest))
    found = asdict(_against_truth(run, clip))
    with suppress(NothingHeldOutError):  # a plain object may have no reliable frame, and has a true shape
        found |= asdict(score_held_out_frames(run, source, largest))
    return found


def _against_truth(run: Path, clip: Path) -> Any:
    from tracking3d_bench.datasets.clip import read_truth
    from tracking3d_bench.datasets.run_answers import answers_of_run
    from tracking3d_bench.evaluation.score import score_mesh

    truth = read_truth(clip)
    if truth.mesh is None:
        raise InputError(f"{clip} has no mesh.obj, which is the true shape; leave out --truth.")
    return score_mesh(answers_of_run(run, truth), truth)


def _cell(key: str, value: float | None) -> str:
    return "-" if value is None else _COLUMNS[key][1].format(value)
