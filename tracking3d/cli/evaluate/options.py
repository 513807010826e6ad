"""Options that the commands of ``tracking3d evaluate`` share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Data = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Where the dataset lies; synthetic suites are made in OUT/data if left out."
    ),
]
Masks = Annotated[
    str,
    typer.Option(
        metavar="SOURCE",
        help="Initial masks: tracker, truth, initial, degraded:IOU, noise:PIXELS, hand, or a folder with one of masks "
        "a sequence.",
    ),
]
Sequences = Annotated[
    list[str] | None,
    typer.Option("--sequence", metavar="PATTERN", help="Only sequences that match; may be repeated."),
]
Jobs = Annotated[int, typer.Option(min=1, max=256, help="Sequences run at the same time.")]
Address = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run them on a Ray cluster: auto, HOST:PORT, ray://HOST:PORT, or local for this machine.",
    ),
]
Out = Annotated[Path, typer.Option(metavar="DIR", help="Folder for data, runs, results and tables.")]


def name_of_settings(config: Path | None, preset: str | None, overrides: list[str] | None, masks: str) -> str:
    """What results are called when nobody says."""
    parts = [config.stem if config else "", preset or ("" if config else "default"), *(overrides or ())]
    source = "" if masks == "tracker" else f"masks {Path(masks).name}"
    return " ".join(part for part in (*parts, source) if part)
