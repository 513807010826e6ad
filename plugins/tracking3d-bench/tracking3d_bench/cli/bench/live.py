"""``tracking3d bench live``: does the pipeline keep up with a camera?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset


def live(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="Clip with frames/ and init.json or masks/.")],
    rate: Annotated[float, typer.Option(min=0.1, max=1000, help="Frames a second that are played.")] = 15.0,
    seconds: Annotated[float, typer.Option(min=1, help="How long; the clip is played to and fro.")] = 20.0,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    debug: Debug = False,
) -> None:
    """Play a clip at a camera's rate through the pipeline: how many frames it drops, and how far answers lag."""
    import json
    from dataclasses import asdict

    from tracking3d.cli.options import configure
    from tracking3d_bench.datasets.clip import read_truth

    settings, truth = configure(config, preset, overrides), read_truth(clip)
    from tracking3d.cli.tables import print_table
    from tracking3d_bench.benchmark.live import format_live, play_live

    report = play_live(settings, truth, seconds, rate)
    if as_json:
        typer.echo(json.dumps(asdict(report)))
    else:
        print_table(format_live(report))
