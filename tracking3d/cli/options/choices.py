"""Options for the quality of a run and for its final mesh."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from tracking3d.cli.options.panels import SETTINGS


def _check_quality(value: str | None) -> str | None:
    from tracking3d.config.choices import check_quality

    return None if value is None else check_quality(value)


def _check_model(value: str | None) -> str | None:
    from tracking3d.config.choices import check_model

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
