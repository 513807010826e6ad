"""The option for the size of the object, which gives all lengths a unit."""

from __future__ import annotations

from typing import Annotated

import typer

from tracking3d.cli.options.panels import OUTPUT


def _check(value: float | None) -> float | None:
    from tracking3d.config.object_size import check_object_size

    return check_object_size(value)


ObjectSize = Annotated[
    float | None,
    typer.Option(
        "--object-size",
        metavar="METRES",
        callback=_check,
        help="Length of the object's longest side; all lengths are then in metres.",
        rich_help_panel=OUTPUT,
    ),
]
