"""Options for the run folder, the report and the viewer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options.object_size import ObjectSize
from tracking3d.cli.options.panels import OUTPUT
from tracking3d.errors import InputError

RunFolder = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Run folder; default runs/<source>.", rich_help_panel=OUTPUT),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace an earlier run in that folder.", rich_help_panel=OUTPUT)
]
Resume = Annotated[
    bool, typer.Option("--resume", help="Continue the stopped run in that folder.", rich_help_panel=OUTPUT)
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
View = Annotated[
    bool,
    typer.Option("--view", help="Show the run in the browser while it is tracked.", rich_help_panel=OUTPUT),
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


@dataclass(frozen=True)
class OutputOptions:
    """What is written and shown."""

    out: RunFolder = None
    overwrite: Overwrite = False
    resume: Resume = False
    object_size: ObjectSize = None
    report: Report = True
    view: View = False
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
