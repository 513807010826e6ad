"""Options of the commands that make suites from a seed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.synthesis.spec import SequenceSpec

Count = Annotated[
    int | None, typer.Option(metavar="N", help="Of the suite fresh: how many sequences; 24 if left out.")
]
Meshes = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Of the suite fresh: mesh files that a third of the sequences show."),
]


def draw_suite(
    name: str, seed: int | None, count: int | None, meshes: Path | None
) -> tuple[str, list[SequenceSpec] | None]:
    """What a suite is called, and its sequences if it is drawn from a seed.

    Raises:
        InputError: If the options do not go with the suite, or make no sense.
    """
    from tracking3d.synthesis.fresh import COUNT, FRESH, fresh_name, fresh_suite

    if name == FRESH:
        if seed is None:
            raise InputError(f"The suite {FRESH} is drawn from a seed; give one by --seed N.")
        specs = fresh_suite(seed, COUNT if count is None else count, meshes)
        return fresh_name(seed, meshes), specs
    options = {"--seed": seed, "--count": count, "--meshes": meshes}
    for option, value in options.items():
        if value is not None:
            raise InputError(f"{option} goes with the suite {FRESH} only, not with {name}; leave it out.")
    return name, None
