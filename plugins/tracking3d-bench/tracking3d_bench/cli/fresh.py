"""Options of the commands that draw suites from a seed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.errors import InputError

if TYPE_CHECKING:
    from tracking3d_bench.synthesis.spec import SequenceSpec

Count = Annotated[
    int | None, typer.Option(metavar="N", help="Number of sequences in the suite 'fresh'; default 24.")
]
Meshes = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR", help="Folder of mesh files, which a third of the sequences in the suite 'fresh' show."
    ),
]


def draw_suite(
    name: str, seed: int | None, count: int | None, meshes: Path | None
) -> tuple[str, list[SequenceSpec] | None]:
    """The name of a suite, and its sequences if it is drawn from a seed.

    Raises:
        InputError: The options do not go with the suite, or have no meaning.
    """
    from tracking3d_bench.synthesis.fresh import COUNT, FRESH, fresh_name, fresh_suite
    from tracking3d_bench.synthesis.phone import PHONE, phone_name, phone_suite

    if name in (FRESH, PHONE) and seed is None:
        raise InputError(f"The suite {name} is drawn from a seed; give one with --seed N.")
    if name == FRESH and seed is not None:
        specs = fresh_suite(seed, COUNT if count is None else count, meshes)
        return fresh_name(seed, meshes), specs
    options = {"--seed": None if name == PHONE else seed, "--count": count, "--meshes": meshes}
    for option, value in options.items():
        if value is not None:
            suites = f"the suites {FRESH} and {PHONE}" if option == "--seed" else f"the suite {FRESH}"
            raise InputError(f"{option} applies to {suites} only, not to {name}; leave it out.")
    if name == PHONE and seed is not None:
        return phone_name(seed), phone_suite(seed)
    return name, None
