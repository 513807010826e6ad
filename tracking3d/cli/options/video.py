"""Options for the frames that are read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import typer

from tracking3d.cli.options.panels import VIDEO

Source = Annotated[
    str,
    typer.Argument(
        metavar="SOURCE",
        help="Video file, image folder, quoted image pattern, camera number, or http(s) or rtsp(s) address.",
    ),
]
Frames = Annotated[
    str | None,
    typer.Option(
        metavar="START:STOP:STEP",
        help="Frames to read, counted from 0; STOP is not included.",
        rich_help_panel=VIDEO,
    ),
]
Fps = Annotated[
    float | None,
    typer.Option(metavar="NUMBER", help="Frame rate of an image folder or pattern.", rich_help_panel=VIDEO),
]
SkipDamaged = Annotated[
    bool,
    typer.Option(
        "--skip-damaged",
        help="If the first frame cannot be decoded, apply the prompt to the first frame that can.",
        rich_help_panel=VIDEO,
    ),
]


@dataclass(frozen=True)
class VideoOptions:
    """Which frames are read, and how."""

    frames: Frames = None
    fps: Fps = None
    skip_damaged: SkipDamaged = False
