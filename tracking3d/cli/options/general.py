"""Options that nearly every command has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options.panels import DATA, VIDEO

Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON only.")]
Run = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")]
RunOrParent = Annotated[
    Path, typer.Argument(metavar="RUN", help="Run folder, or the folder that holds those of several objects.")
]
Video = Annotated[
    str | None,
    typer.Option(
        "--source",
        metavar="VIDEO",
        help="Path of the video, if it has moved since the run.",
        rich_help_panel=VIDEO,
    ),
]
Sequences = Annotated[
    list[str] | None,
    typer.Option(
        "--sequence",
        metavar="PATTERN",
        help="Use only sequences whose name matches; may be repeated.",
        rich_help_panel=DATA,
    ),
]
