"""``tracking3d evaluate table``: the paper's tables with our figures beside its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.evaluate.options import Address, Data, Jobs, Masks, Out, Sequences, name_of_settings
from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quiet, configure
from tracking3d.errors import InputError


def table(
    name: Annotated[
        str,
        typer.Argument(
            metavar="TABLE",
            help="cdtb, inhand, coin, ablation, features, bop or keyframes; or online, the solvers side by side.",
        ),
    ],
    data: Data = None,
    suite: Annotated[
        str, typer.Option(metavar="NAME", help="Synthetic suite that is run where --data is left out.")
    ] = "standard",
    initial: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TRACKER=DIR", help="Masks of a tracker, a folder for every sequence; may be repeated."
        ),
    ] = None,
    rows: Annotated[
        list[str] | None,
        typer.Option("--row", metavar="PATTERN", help="Only rows that match; may be repeated."),
    ] = None,
    masks: Masks = "tracker",
    sequences: Sequences = None,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw it into an .svg, .png or .pdf too.")
    ] = None,
    jobs: Jobs = 1,
    address: Address = None,
    out: Out = Path("benchmark"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run what a table of the paper needs and print its figures and ours side by side.

    With --data on the real dataset; without it on a synthetic suite, which the caption says. Writes
    DIR/tables/TABLE.md, .csv and .json. The table online takes clips in our own layout with --data, and --masks; the
    others say themselves which masks they start from.
    """
    from tracking3d.benchmark import solver_table
    from tracking3d.benchmark.sequences import REAL, open_dataset
    from tracking3d.benchmark.table import fill, format_table, to_json, write_table
    from tracking3d.benchmark.table_plot import plot_table
    from tracking3d.benchmark.tables import TABLES
    from tracking3d.benchmark.variant import Variant, check_masks
    from tracking3d.cli.evaluate.progress import jobs_progress, making_progress
    from tracking3d.cli.tables import print_table
    from tracking3d.speed.plot import check_plot

    of_solvers = name == solver_table.NAME
    if name not in TABLES and not of_solvers:
        raise InputError(
            f"There is no table '{name}'; choose one of {', '.join([*TABLES, solver_table.NAME])}."
        )
    _check_options(name, of_solvers, {"--initial": initial, "--plot": plot}, masks)
    check_masks(masks)
    if plot:
        check_plot(plot)
    folders = dict(_named_folder(item) for item in initial or ())
    # The paper's tables vary what only its solver has.
    settings = configure(config, preset or (None if config or of_solvers else "rerendering"), overrides)
    label = name_of_settings(config, preset, overrides, "tracker")
    base = Variant(label=label, config=settings, masks=masks)
    real = REAL if of_solvers else TABLES[name].dataset
    wanted = None if of_solvers else TABLES[name].only(rows or [])
    with making_progress(quiet) as made:
        dataset = open_dataset(real if data else suite, data, out, jobs, made).only(sequences or [])
    with jobs_progress(None, quiet) as listener:
        if wanted is None:
            solvers = solver_table.fill(base, dataset, out, rows or [], jobs, listener, address)
            files = solver_table.write_table(solvers, out / "tables")
            text, printed = solver_table.to_json(solvers), solver_table.format_table(solvers)
        else:
            filled = fill(wanted, base, dataset, out, jobs, folders, listener, address)
            files = write_table(filled, out / "tables")
            text, printed = to_json(filled), [format_table(filled)]
            if plot:
                plot_table(filled, plot)
    if as_json:
        typer.echo(text, nl=False)
    elif not quiet:
        for one in printed:
            print_table(one)
        typer.echo("\n".join(str(file) for file in files))


def _check_options(name: str, of_solvers: bool, of_papers: dict[str, object], masks: str) -> None:
    """Refuse options that the other kind of table has."""
    given = next((option for option, value in of_papers.items() if value), None)
    if of_solvers and given:
        raise InputError(f"Table {name} takes no {given}; leave it out.")
    if not of_solvers and masks != "tracker":
        raise InputError(f"Table {name} takes no --masks: its rows say what they start from; leave it out.")


def _named_folder(item: str) -> tuple[str, Path]:
    name, equals, folder = item.partition("=")
    if not equals or not Path(folder).is_dir():
        raise InputError(f"--initial {item} names no folder that exists; write it as TRACKER=DIR.")
    return name.lower(), Path(folder)
