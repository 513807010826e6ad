"""Options of the commands that draw suites from a seed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d.synthesis.spec import SequenceSpec

Count = Annotated[
    int | None, typer.Option(metavar="N", help="Number of sequences in the suite 'fresh'; default 24.")
]
Meshes = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Folder of mesh files, which a third of the sequences in the suite 'fresh' show."
    ),
]


def drawn_suite(
    name: str, seed: int | None, count: int | None, meshes: Path | None
) -> tuple[str, list[SequenceSpec] | None]:
    """The name of a suite, and its sequences if it is drawn from a seed.

    Raises:
        InputError: The options do not go with the suite, or have no meaning.
    """
    from tracking3d.synthesis.fresh import COUNT, FRESH, fresh_name, fresh_suite

    if name == FRESH:
        if seed is None:
            raise InputError(f"The suite {FRESH} is drawn from a seed; give one with --seed N.")
        specs = fresh_suite(seed, COUNT if count is None else count, meshes)
        return fresh_name(seed, meshes), specs
    options = {"--seed": seed, "--count": count, "--meshes": meshes}
    for option, value in options.items():
        if value is not None:
            raise InputError(f"{option} applies to the suite {FRESH} only, not to {name}; leave it out.")
    return name, None
