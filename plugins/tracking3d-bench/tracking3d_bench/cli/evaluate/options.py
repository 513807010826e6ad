"""Options that the commands of ``tracking3d evaluate`` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options.general import DATA, OUTPUT, PERFORMANCE

Data = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder of the dataset; synthetic suites are rendered into OUT/data if left out.",
        rich_help_panel=DATA,
    ),
]
Masks = Annotated[
    str,
    typer.Option(
        metavar="SOURCE",
        help="Initial masks: tracker, truth, initial, degraded:IOU, noise:PIXELS, hand, or a folder with a mask folder "
        "for each sequence.",
        rich_help_panel=DATA,
    ),
]
Jobs = Annotated[
    int,
    typer.Option(
        metavar="N",
        min=1,
        max=256,
        help="Sequences processed at the same time.",
        rich_help_panel=PERFORMANCE,
    ),
]
Out = Annotated[
    Path,
    typer.Option(metavar="DIR", help="Folder for data, runs, results and tables.", rich_help_panel=OUTPUT),
]
Truth = Annotated[
    Path,
    typer.Option(
        metavar="CLIP",
        help="Clip with the ground truth: frames/, masks/ and poses.json.",
        rich_help_panel=DATA,
    ),
]


def name_of_settings(config: Path | None, preset: str | None, overrides: list[str] | None, masks: str) -> str:
    """The default label of results: the settings that differ from the default."""
    parts = [config.stem if config else "", preset or ("" if config else "default"), *(overrides or ())]
    source = "" if masks == "tracker" else f"masks {Path(masks).name}"
    return " ".join(part for part in (*parts, source) if part)
