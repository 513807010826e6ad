"""``tracking3d batch JOBS --out DIR``: track many videos."""

from __future__ import annotations

import logging
import posixpath
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import typer

from tracking3d.cli.options import Debug, Quiet, SettingsOptions, configure, grouped, numbers
from tracking3d.cli.options.general import DATA, OUTPUT, PERFORMANCE, Sequences
from tracking3d.cli.options.output import Address
from tracking3d.cli.options.prompt import BoxFormat
from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.batch.rows import VideoRow
    from tracking3d.batch.video_job import VideoJob
    from tracking3d.config.models import PipelineConfig
    from tracking3d.engines.protocol import Needs


_MOST_NAMES = 5
"""Videos without a prompt that are named."""

Jobs = Annotated[
    str,
    typer.Argument(
        metavar="JOBS",
        help="Folder or quoted pattern of videos, with box or mask files next to them; a table (.csv, .jsonl, "
        ".parquet); or with --data the name of a dataset.",
    ),
]
Out = Annotated[
    str,
    typer.Option(
        metavar="DIR",
        help="Folder for the run folders and tables; may be an s3:// or gs:// address.",
        rich_help_panel=OUTPUT,
    ),
]
Data = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder of the dataset that JOBS names, as for `evaluate suite`.",
        rich_help_panel=DATA,
    ),
]
Retries = Annotated[
    int,
    typer.Option(
        metavar="N",
        min=0,
        max=100,
        help="Number of times that a failed video is tried again.",
        rich_help_panel=PERFORMANCE,
    ),
]
Split = Annotated[
    str | None,
    typer.Option(
        metavar="SECONDS",
        help="Cut long videos into parts of about this length (900f counts frames), track each part as a task of its "
        "own, and merge the results.",
        rich_help_panel=PERFORMANCE,
    ),
]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Track every video again, and replace existing run folders.",
        rich_help_panel=OUTPUT,
    ),
]
Report = Annotated[
    bool,
    typer.Option(
        "--report/--no-report",
        help="Write report.html for each run.",
        show_default=False,
        rich_help_panel=OUTPUT,
    ),
]
JsonEvents = Annotated[
    bool, typer.Option("--json", help="Print every event as one line of JSON.", rich_help_panel=OUTPUT)
]


@dataclass(frozen=True)
class EngineOptions:
    """Where the videos are tracked, and with what resources."""

    PANEL: ClassVar = PERFORMANCE

    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, max=100_000, help="Videos tracked at the same time; default one per core."
        ),
    ] = None
    address: Address = None
    threads: Annotated[
        int,
        typer.Option(metavar="N", min=1, max=256, help="Cores for each video."),
    ] = 1
    memory: Annotated[
        int | None,
        typer.Option(metavar="MB", min=1, help="Memory reserved for each video."),
    ] = None


@grouped
def run(
    jobs: Jobs,
    *,
    data: Data = None,
    sequences: Sequences = None,
    box_format: BoxFormat = None,
    settings: SettingsOptions,
    out: Out,
    overwrite: Overwrite = False,
    report: Report = True,
    engine: EngineOptions,
    retries: Retries = 1,
    split: Split = None,
    as_json: JsonEvents = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Track every video of JOBS, each into a run folder of its own in DIR.

    To continue a stopped batch, repeat the command. DIR/results.csv (and .parquet), DIR/failures.csv and DIR/index.html
    grow as videos finish. The exit code is 1 if a video failed.
    """
    from tracking3d.trackers.prompts.boxes import check_box_format

    if quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    written = check_box_format(box_format or "xywh")
    if sequences and data is None:
        raise InputError(
            "--sequence names sequences of a dataset; give its folder with --data, or leave it out."
        )
    if split is not None:
        from tracking3d.pipeline.submaps.cuts import parse_length

        parse_length(split, 1e9)  # refuses what is no length at any frame rate
    # Fail once for a wrong option, not once per video.
    config = settings.configure(runtime=_runtime(engine.threads))
    from tracking3d.batch.listing import dataset_jobs, list_jobs

    if split is not None:
        _check_split(config, out, data, engine.address)
    if data is not None:
        from tracking3d.batch.datasets import dataset_reader

        videos = dataset_jobs(dataset_reader().open_sequences(jobs, data, sequences or []), config)
    else:
        videos = list_jobs(
            jobs, lambda row: _build_config(row, settings, engine.threads), split or "", written
        )
        _check_prompts(jobs, videos, quiet)
    from tracking3d.cli.progress import load_with_progress

    load_with_progress("tracking3d.batch.running", quiet or as_json, kernels=True)
    from tracking3d.batch.running import run_batch
    from tracking3d.batch.storage import absolute
    from tracking3d.cli.batch.progress import show_batch_progress
    from tracking3d.engines.choosing import open_engine

    needs = _needs(videos, engine)
    with (
        open_engine(engine.address, engine.workers, needs) as workers,
        show_batch_progress(quiet, as_json) as listener,
    ):
        try:
            progress = run_batch(
                videos,
                absolute(out),
                workers,
                retries=retries,
                overwrite=overwrite,
                report=report,
                command=shlex.join(sys.argv),
                listener=listener,
            )
        except BaseException as error:
            error.add_note("To continue the batch, repeat the command.")
            raise
    if progress.failed:
        raise typer.Exit(1)


def _check_prompts(jobs: str, videos: Sequence[VideoJob], quiet: bool) -> None:
    """Say before anything is tracked which videos have no prompt.

    Raises:
        InputError: None of them has one.
    """
    from tracking3d.batch.listing import NO_PROMPT

    missing = [video for video in videos if video.fault == NO_PROMPT]
    if not missing:
        return
    example = posixpath.splitext(missing[0].video)[0] + ".box"
    what_to_do = (
        f"write X,Y,WIDTH,HEIGHT of the object in the first frame into a file next to each video, such as {example}, "
        "or add a column box to a table."
    )
    if len(missing) == len(videos):
        number = "The only video" if len(videos) == 1 else f"None of the {len(videos)} videos"
        raise InputError(f"{number} of {jobs} has {'no' if len(videos) == 1 else 'a'} box; {what_to_do}")
    if not quiet:
        names = ", ".join(video.name for video in missing[:_MOST_NAMES])
        more = f" and {len(missing) - _MOST_NAMES} more" if len(missing) > _MOST_NAMES else ""
        typer.echo(
            f"{len(missing)} of {len(videos)} videos have no box and will fail ({names}{more}); {what_to_do}",
            err=True,
        )


def _needs(videos: Sequence[VideoJob], engine: EngineOptions) -> Needs:
    """What each video needs of a worker."""
    from tracking3d.engines.protocol import Needs

    gpus = any(video.config.runtime.device.startswith("cuda") for video in videos)
    return Needs(engine.threads, engine.memory or 0.0, 1.0 if gpus else 0.0)


def _check_split(settings: PipelineConfig, out: str, data: Path | None, address: str | None) -> None:
    from tracking3d.batch.storage import local
    from tracking3d.pipeline.submaps.job import refuse_what_cannot_be_joined

    refuse_what_cannot_be_joined(settings)
    if data is not None:
        raise InputError("--split cuts videos, but --data gives sequences of a dataset; leave out --split.")
    if address is not None and local(out) is None:
        raise InputError(
            "--split on a cluster merges the parts of a video in a folder that all machines can access, but "
            f"--out {out} is not one; give a shared folder."
        )


def _build_config(row: VideoRow, settings: SettingsOptions, threads: int) -> PipelineConfig:
    """The configuration of a row: its own settings override those of the command line."""
    tracker: dict[str, str | None] = {"name": row.tracker}
    if row.masks is not None:
        tracker = {"name": "precomputed", "path": row.masks}
    camera = None
    if row.intrinsics is not None:
        camera = numbers(row.intrinsics, 4, "The column intrinsics", "FX,FY,CX,CY in pixels")
    return configure(
        settings.config,
        row.preset or settings.preset,
        [*(settings.overrides or ()), *row.settings],
        row.quality or settings.quality,
        row.model or settings.model,
        tracker=tracker,
        features=row.features,
        camera={"fov": row.fov, "intrinsics": camera},
        runtime=_runtime(threads),
    )


def _runtime(threads: int) -> dict[str, int]:
    return {"threads": threads} if threads > 1 else {}
