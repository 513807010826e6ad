"""Is a long video tracked faster in parts than whole, and as well?

python benchmarks/split.py --frames 1200 --workers 2
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from script import run
from tracking3d.cli.options import ConfigFile, Overrides, Preset


def split(
    frames: Annotated[int, typer.Option(min=60, help="How many frames.")] = 600,
    part: Annotated[
        int | None, typer.Option(min=24, help="Frames of a part.", show_default="one part a worker")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Parts at a time.")] = 2,
    masks: Annotated[
        str,
        typer.Option(metavar="truth|tracker", help="True masks with noisy outlines, or the mask tracker's."),
    ] = "truth",
    width: Annotated[
        int, typer.Option(min=96, max=4096, help="Width of the frames; the height is 3/4.")
    ] = 320,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep video and runs there.", show_default="a temporary one"),
    ] = None,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
) -> None:
    """Track a synthetic clip, played to and fro, whole and in parts: seconds, and rotation against the truth."""
    import json
    import tempfile
    from dataclasses import asdict

    from split_benefit import format_split, measure_split
    from tracking3d.cli.options import configure
    from tracking3d.cli.tables import print_table

    settings = configure(config, preset, overrides)
    with tempfile.TemporaryDirectory() as temporary:
        measured = measure_split(
            settings,
            out or Path(temporary),
            frames=frames,
            length=part or max(frames // max(workers, 2), 24),
            workers=workers,
            masks=masks,
            size=(width, width * 3 // 4),
            told=lambda sentence: typer.echo(sentence, err=True),
        )
    if as_json:
        typer.echo(json.dumps({name: asdict(one) for name, one in measured.items()}))
    else:
        print_table(format_split(measured))


if __name__ == "__main__":
    run(split)
