"""``tracking3d bench batch``: how much faster more workers are, and what a batch outlives."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quality


def batch(
    videos: Annotated[
        int, typer.Option("--clips", "--videos", min=1, max=100_000, help="How many synthetic clips.")
    ] = 200,
    frames: Annotated[int, typer.Option(min=2, help="How many frames each has.")] = 10,
    width: Annotated[
        int, typer.Option(min=48, max=4096, help="Width of the frames; the height is 3/4.")
    ] = 320,
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
    with_faults: Annotated[
        int,
        typer.Option("--fault-clips", min=1, help="How many of them go through that."),
    ] = 60,
    minutes: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            help="Stop after so long, with what there is until then, as after Ctrl-C.",
            show_default=False,
        ),
    ] = None,
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

    Where no settings are given, they are those of a draft with a coarse object and the true lens, so that it is the
    batch that is measured. The exit code is 1 where answers differ, or a fault cost another video.
    """
    import math
    import tempfile

    from tracking3d.batch.demonstration import ABORTING, DAMAGED, QUICK, Asked, demonstrate, speed_up, to_json
    from tracking3d.cli.options import configure
    from tracking3d.cli.tables import print_table

    if config is None and preset is None and quality is None:
        quality, overrides = "draft", [*QUICK, *(overrides or ())]
    settings = configure(config, preset, overrides, quality)
    asked = Asked(
        videos,
        frames,
        (width, width * 3 // 4),
        workers or (1, 2),
        address,
        with_faults if faults else 0,
        report,
        math.inf if minutes is None else minutes,
    )
    with tempfile.TemporaryDirectory() as temporary:
        passes = demonstrate(settings, out or Path(temporary), asked, lambda text: typer.echo(text, err=True))
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
                    f"{one.load['shared_memory']:.1f} MB of shared memory, {one.load['unfinished']:.1f} MB of work "
                    "that is not whole"
                )
            if one.growth:
                typer.echo(
                    f"{one.label}: from the second quarter to the last {one.growth['own_memory']:+.1f} MB and "
                    f"{one.growth['own_descriptors']:+.1f} open files in the first process, "
                    f"{one.growth['memory']:+.1f} MB and {one.growth['descriptors']:+.1f} open files in all, "
                    f"{one.growth['shared_memory']:+.1f} MB of shared memory, {one.growth['unfinished']:+.1f} MB of "
                    "work that is not whole"
                )
        if (times := speed_up(passes)) is not None:
            typer.echo(f"{times:.2f} times as fast")
    expected = {DAMAGED, ABORTING}
    if any(one.different > 1e-3 or set(one.failed) - expected for one in passes):
        raise typer.Exit(1)
