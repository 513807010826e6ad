"""Options that nearly every command has."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from tracking3d.errors import InputError

PROMPT = "Prompt"
VIDEO = "Video"
DATA = "Data"
TRACKING = "Tracking"
CAMERA = "Camera"
SETTINGS = "Settings"
OUTPUT = "Output"
PERFORMANCE = "Performance"


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


def numbers(text: str, count: int, option: str, form: str) -> tuple[float, ...]:
    """Read ``count`` finite numbers that are separated by commas.

    Raises:
        InputError: The text is anything else; the sentence names the ``option`` and its ``form``.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        count_in_words = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f"{option} '{text}' is not {count_in_words}; write it as {form}.")
    return values


def _check_quality(value: str | None) -> str | None:
    from tracking3d.config.loading import check_quality

    return None if value is None else check_quality(value)


def _check_model(value: str | None) -> str | None:
    from tracking3d.config.loading import check_model

    return None if value is None else check_model(value)


def model_option(**more: Any) -> Any:
    """The option ``--model``; ``more`` are further arguments of typer's `Option`."""
    return typer.Option(
        "--model",
        metavar="auto|none|fast|fine",
        callback=_check_model,
        help="Final mesh: none keeps the online texture, fast re-textures from the video, fine also reconstructs the "
        "shape, auto does so where it can.",
        **more,
    )


Quality = Annotated[
    str | None,
    typer.Option(
        metavar="draft|good|best",
        callback=_check_quality,
        help="Trade speed for quality: chooses tracker, resolution, refinement and final mesh together.",
        rich_help_panel=SETTINGS,
    ),
]
Model = Annotated[str | None, model_option(show_default="auto", rich_help_panel=SETTINGS)]
