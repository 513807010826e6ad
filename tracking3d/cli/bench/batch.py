"""``tracking3d bench batch``: how much faster more workers are, and what a batch outlives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quality


def batch(
    videos: Annotated[int, typer.Option(min=1, max=100_000, help="How many synthetic clips.")] = 200,
    frames: Annotated[int, typer.Option(min=4, help="How many frames each has.")] = 20,
    workers: Annotated[
        list[int] | None,
        typer.Option(
            min=1, help="Videos at a time; may be repeated, 1 and 2 if left out.", show_default=False
        ),
    ] = None,
    address: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="Ray cluster, as of `batch`; processes of this machine if left out."
        ),
    ] = None,
    faults: Annotated[
        bool,
        typer.Option(
            "--faults/--no-faults",
            help="Go through them once more with a worker killed, a clip damaged, a plug-in that aborts, and the "
            "disk full once.",
            show_default=False,
        ),
    ] = True,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write reports of the runs.", show_default=False)
    ] = True,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep clips and results there.", show_default="a temporary one"),
    ] = None,
    config: ConfigFile = None,
    preset: Preset = None,
    quality: Quality = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Track synthetic clips with one worker and with two, and once more with faults; are all answers the same?

    The exit code is 1 where answers differ, or a fault cost another video.
    """
    import tempfile

    from tracking3d.batch.demonstration import ABORTING, DAMAGED, demonstrate, speed_up, to_json
    from tracking3d.cli.options import configure
    from tracking3d.cli.tables import print_table

    settings = configure(config, preset, overrides, quality)
    with tempfile.TemporaryDirectory() as temporary:
        passes = demonstrate(
            settings,
            out or Path(temporary),
            videos,
            frames,
            workers or (1, 2),
            address,
            faults,
            report,
            said=lambda text: typer.echo(text, err=True),
        )
    if as_json:
        typer.echo(to_json(passes))
    else:
        from rich.table import Table

        table = Table("", "workers", "seconds", "videos", "frames/s", "difference", "tried again", "failed")
        for one in passes:
            table.add_row(
                one.label,
                str(one.workers),
                f"{one.seconds:.1f}",
                str(one.finished),
                f"{one.frames_per_second:.2f}",
                f"{one.different:.1e}",
                str(len(one.again)),
                str(len(one.failed)),
            )
        print_table(table)
        for one in passes:
            for video, reason in one.failed.items():
                typer.echo(f"{one.label}, {video}: {reason}")
            if one.load:
                typer.echo(
                    f"{one.label}: at most {one.load['memory']:.0f} MB in {one.load['processes']:.0f} processes "
                    f"({one.load['own_memory']:.0f} MB in the first), {one.load['descriptors']:.0f} open files, "
                    f"{one.load['shared_memory']:.1f} MB of shared memory"
                )
            if one.growth:
                typer.echo(
                    f"{one.label}: from the second quarter to the last {one.growth['own_memory']:+.1f} MB and "
                    f"{one.growth['own_descriptors']:+.1f} open files in the first process"
                )
        if (times := speed_up(passes)) is not None:
            typer.echo(f"{times:.2f} times as fast")
    expected = {DAMAGED, ABORTING}
    if any(one.different > 1e-3 or set(one.failed) - expected for one in passes):
        raise typer.Exit(1)
