"""``tracking3d batch JOBS --out DIR``: track many videos."""

from __future__ import annotations

import logging
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quality, Quiet, configure, numbers

if TYPE_CHECKING:
    from tracking3d.batch.rows import VideoRow
    from tracking3d.batch.video_job import VideoJob
    from tracking3d.config.models import PipelineConfig

_ENGINE = "Where the work is done"


def run(
    jobs: Annotated[
        str,
        typer.Argument(
            metavar="JOBS",
            help="Folder or pattern of videos with boxes or masks beside them, a table (.csv, .jsonl, .parquet), or "
            "with --data the name of a dataset.",
        ),
    ],
    out: Annotated[
        str, typer.Option(metavar="DIR", help="Folder for the run folders and tables; may be s3:// or gs://.")
    ],
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where the dataset lies that JOBS names, as for `evaluate suite`."),
    ] = None,
    sequences: Annotated[
        list[str] | None,
        typer.Option(
            "--sequence", metavar="PATTERN", help="Of a dataset: only sequences that match; may be repeated."
        ),
    ] = None,
    retries: Annotated[
        int, typer.Option(min=0, max=100, help="How often a video that came to nothing is tried again.")
    ] = 1,
    split: Annotated[
        str | None,
        typer.Option(
            metavar="SECONDS",
            help="Cut long videos into parts of about that length (or frames, as 900f), each a task of its own, and "
            "join them.",
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Track all again, and replace run folders that are there.")
    ] = False,
    report: Annotated[
        bool,
        typer.Option("--report/--no-report", help="Write report.html of each run.", show_default=False),
    ] = True,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=100_000,
            help="Videos at a time; as many as there are cores if left out.",
            rich_help_panel=_ENGINE,
        ),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Ray cluster: auto, HOST:PORT, ray://HOST:PORT, or local for a Ray on this machine.",
            rich_help_panel=_ENGINE,
        ),
    ] = None,
    threads: Annotated[
        int, typer.Option(min=1, max=256, help="Cores of each video.", rich_help_panel=_ENGINE)
    ] = 1,
    memory: Annotated[
        int | None,
        typer.Option(
            metavar="MB", min=1, help="Memory that each video is given room for.", rich_help_panel=_ENGINE
        ),
    ] = None,
    config: ConfigFile = None,
    preset: Preset = None,
    quality: Quality = None,
    overrides: Overrides = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print an event as one line of JSON for all that happens.")
    ] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Track every video of JOBS into a run folder of its own within DIR; the same command goes on where it stopped.

    DIR/results.csv (and .parquet), DIR/failures.csv and DIR/index.html grow as videos end. The exit code is 1 where a
    video came to nothing.
    """
    from tracking3d.batch.listing import dataset_jobs, list_jobs
    from tracking3d.batch.places import absolute
    from tracking3d.batch.running import run_batch
    from tracking3d.benchmark.sequences import open_dataset
    from tracking3d.cli.batch.progress import show_batch_progress
    from tracking3d.engines.choosing import open_engine
    from tracking3d.engines.protocol import Needs

    def of_row(row: VideoRow) -> PipelineConfig:
        return _configured(row, config, preset, quality, overrides, threads)

    if quiet:
        logging.getLogger("tracking3d").setLevel(logging.ERROR)
    videos: list[VideoJob]
    # What is wrong on the command line is no fault of any video.
    settings = configure(config, preset, overrides, quality, runtime=_runtime(threads))
    if split is not None:
        _check_split(split, settings, out, data, address)
    if data is not None:
        videos = dataset_jobs(open_dataset(jobs, data, data, 1).only(sequences or []), settings)
    else:
        videos = list_jobs(jobs, of_row, split or "")
    gpus = any(video.config.runtime.device.startswith("cuda") for video in videos)
    needs = Needs(threads, memory or 0.0, 1.0 if gpus else 0.0)
    command = shlex.join(sys.argv)
    with open_engine(address, workers, needs) as engine, show_batch_progress(quiet, as_json) as listener:
        try:
            progress = run_batch(
                videos,
                absolute(out),
                engine,
                retries=retries,
                overwrite=overwrite,
                report=report,
                command=command,
                listener=listener,
            )
        except BaseException as error:
            error.add_note("The same command goes on from there.")
            raise
    if progress.failed:
        raise typer.Exit(1)


def _check_split(
    split: str, settings: PipelineConfig, out: str, data: Path | None, address: str | None
) -> None:
    from tracking3d.batch.places import local
    from tracking3d.errors import InputError
    from tracking3d.splitting.cutting import parse_length
    from tracking3d.splitting.long_video import refuse_what_cannot_be_joined

    refuse_what_cannot_be_joined(settings)
    parse_length(split, 1e9)  # what is no length at all; the rate of each video tells the rest
    if data is not None:
        raise InputError("--split cuts videos, not sequences of a dataset; leave out --split.")
    if address is not None and local(out) is None:
        raise InputError(
            f"--split on a cluster needs a folder that all machines see, for parts of one video meet there; {out} is "
            "none: give --out a shared folder."
        )


def _configured(
    row: VideoRow,
    config: Path | None,
    preset: str | None,
    quality: str | None,
    overrides: list[str] | None,
    threads: int,
) -> PipelineConfig:
    """The pipeline of a row: what it says goes before what the command line says."""
    tracker: dict[str, str | None] = {"name": row.tracker}
    if row.masks is not None:
        tracker = {"name": "precomputed", "path": row.masks}
    camera = None
    if row.intrinsics is not None:
        camera = numbers(row.intrinsics, 4, "The column intrinsics", "FX,FY,CX,CY in pixels")
    return configure(
        config,
        row.preset or preset,
        [*(overrides or ()), *row.settings],
        row.quality or quality,
        tracker=tracker,
        features=row.features,
        camera={"fov": row.fov, "intrinsics": camera},
        runtime=_runtime(threads),
    )


def _runtime(threads: int) -> dict[str, int]:
    return {"threads": threads} if threads > 1 else {}
