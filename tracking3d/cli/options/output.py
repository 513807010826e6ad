"""Options for the run folder, the report and the viewer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import typer

from tracking3d.cli.options.general import OUTPUT, PERFORMANCE, KeyOption
from tracking3d.errors import InputError


def _check(value: float | None) -> float | None:
    from tracking3d.config.camera import check_object_size

    return check_object_size(value)


ObjectSize = Annotated[
    float | None,
    KeyOption("object.size", "METRES", "--object-size", callback=_check, rich_help_panel=OUTPUT),
]
RunFolder = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Run folder; default runs/<source>.", rich_help_panel=OUTPUT),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace an earlier run in that folder.", rich_help_panel=OUTPUT)
]
Report = Annotated[
    bool,
    typer.Option(
        "--report/--no-report",
        help="Write report.html and turntable.mp4 when the run ends, even if it was stopped.",
        show_default=False,
        rich_help_panel=OUTPUT,
    ),
]
Host = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Serve the page to other machines too, on this network address; the printed link contains a token.",
        rich_help_panel=OUTPUT,
    ),
]
Browser = Annotated[
    bool,
    typer.Option(
        "--browser/--no-browser",
        help="Open the page in the browser, if started from a terminal.",
        rich_help_panel=OUTPUT,
    ),
]
Port = Annotated[
    int,
    typer.Option(
        min=0,
        max=65535,
        help="Port, or the next free one above it; 0 for any free port.",
        rich_help_panel=OUTPUT,
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
class OutputOptions:
    """What is written and shown."""

    PANEL: ClassVar = OUTPUT

    out: RunFolder = None
    overwrite: Overwrite = False
    resume: Annotated[bool, typer.Option("--resume", help="Continue the stopped run in that folder.")] = False
    object_size: ObjectSize = None
    report: Report = True
    view: Annotated[bool, typer.Option("--view", help="Show the run in the browser while it is tracked.")] = (
        False
    )
    host: Host = None

    def check(self) -> None:
        """Make sure that the options go together.

        Raises:
            InputError: Two of them do not.
        """
        if self.resume and self.overwrite:
            raise InputError(
                "Give either --resume, which continues the earlier run, or --overwrite, which replaces it."
            )
        if self.host is not None and not self.view:
            raise InputError("--host is the address that --view serves its page on; add --view.")


@dataclass(frozen=True)
class PerformanceOptions:
    """Resolution, device and parallel parts."""

    PANEL: ClassVar = PERFORMANCE

    size: Annotated[int | None, KeyOption("crop.size", "PIXELS")] = None
    device: Annotated[str | None, KeyOption("runtime.device", "NAME")] = None
    split: Annotated[
        str | None,
        typer.Option(
            metavar="SECONDS",
            help="Cut a long video into parts of about this length, track them in parallel, and merge the results.",
        ),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Parts of --split tracked at the same time; default one per processor."
        ),
    ] = None

    def check(self) -> None:
        """Make sure that the options go together.

        Raises:
            InputError: Two of them do not, or the length of the parts is none.
        """
        if self.workers is not None and self.split is None:
            raise InputError("--workers is the number of parts that --split tracks at a time; add --split.")
        if self.split is not None:
            from tracking3d.pipeline.submaps.cuts import parse_length

            parse_length(self.split, 1e9)  # refuses what is no length at any frame rate
