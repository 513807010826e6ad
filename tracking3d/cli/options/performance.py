"""Options for speed and memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from tracking3d.cli.options.panels import PERFORMANCE
from tracking3d.errors import InputError

Size = Annotated[
    int | None,
    typer.Option(
        metavar="PIXELS",
        help="Working resolution: side of the square crop around the object.",
        rich_help_panel=PERFORMANCE,
    ),
]
Device = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Device: cpu, cuda or cuda:N.", rich_help_panel=PERFORMANCE),
]
Split = Annotated[
    str | None,
    typer.Option(
        metavar="SECONDS",
        help="Cut a long video into parts of about this length, track them in parallel, and merge the results.",
        rich_help_panel=PERFORMANCE,
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Parts of --split tracked at the same time; default one per processor.",
        rich_help_panel=PERFORMANCE,
    ),
]

Address = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Ray cluster to run on: auto, HOST:PORT, ray://HOST:PORT, or local to start Ray on this machine.",
        rich_help_panel=PERFORMANCE,
    ),
]


@dataclass(frozen=True)
class PerformanceOptions:
    """Resolution, device and parallel parts."""

    size: Size = None
    device: Device = None
    split: Split = None
    workers: Workers = None

    def check(self) -> None:
        """Make sure that the options go together.

        Raises:
            InputError: Two of them do not, or the length of the parts is none.
        """
        if self.workers is not None and self.split is None:
            raise InputError("--workers is the number of parts that --split tracks at a time; add --split.")
        if self.split is not None:
            from tracking3d.submaps.cuts import parse_length

            parse_length(self.split, 1e9)  # refuses what is no length at any frame rate
