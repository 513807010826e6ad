"""How much faster are more workers, and what does a batch survive?

python benchmarks/batch.py --clips 60 --minutes 10 --out bench
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from script import run
from tracking3d.cli.options import ConfigFile, Overrides, Preset, Quality

if TYPE_CHECKING:
    from batch_passes import Pass

Address = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS", help="Ray cluster, as of `batch`; processes of this machine if left out."
    ),
]
Faults = Annotated[
    bool,
    typer.Option(
        "--faults/--no-faults",
        help="Track them again with a worker killed, a clip damaged, a plug-in that aborts, and a disk that is full "
        "once.",
        show_default=False,
    ),
]
Minutes = Annotated[
    float | None,
    typer.Option(
        min=0.01,
        help="Stop after so long with the videos finished by then, as after Ctrl-C.",
        show_default=False,
    ),
]


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
    address: Address = None,
    faults: Faults = True,
    with_faults: Annotated[
        int, typer.Option("--fault-clips", min=1, help="How many of the clips are tracked again with faults.")
    ] = 60,
    minutes: Minutes = None,
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
) -> None:
    """Track synthetic clips with one worker and with two, and again with faults; compare all poses.

    Without settings they are those of a draft with a coarse object and the true lens, so that the batch is measured
    and not the solver. The exit code is 1 if poses differ or a fault cost another video.
    """
    import math
    import tempfile

    from batch_passes import QUICK, Asked, demonstrate, to_json
    from tracking3d.cli.options import configure

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
        _print(passes)
    if not _as_expected(passes):
        raise typer.Exit(1)


def _print(passes: Sequence[Pass]) -> None:
    """Print a table of the passes, why videos failed, and what each pass took of the machine."""
    from batch_passes import format_passes, load_in_words, speed_up
    from tracking3d.cli.tables import print_table

    print_table(format_passes(passes))
    for one in passes:
        for video, reason in one.failed.items():
            typer.echo(f"{one.label}, {video}: {reason}")
        for sentence in load_in_words(one):
            typer.echo(sentence)
    if (times := speed_up(passes)) is not None:
        typer.echo(f"{times:.2f} times as fast")


def _as_expected(passes: Sequence[Pass]) -> bool:
    """Whether all poses agree and no video failed but those that have to."""
    from batch_passes import ABORTING, DAMAGED

    return not any(one.different > 1e-3 or set(one.failed) - {DAMAGED, ABORTING} for one in passes)


if __name__ == "__main__":
    run(batch)
