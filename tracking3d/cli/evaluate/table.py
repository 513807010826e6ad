"""``tracking3d evaluate table``: the paper's tables with our figures beside its own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.evaluate.options import Data, Jobs, Out, Sequences, name_of_settings
from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quiet, configure
from tracking3d.errors import InputError


def table(
    name: Annotated[
        str, typer.Argument(metavar="TABLE", help="cdtb, inhand, coin, ablation, features, bop or keyframes.")
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
    sequences: Sequences = None,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw it into an .svg, .png or .pdf too.")
    ] = None,
    jobs: Jobs = 1,
    out: Out = Path("benchmark"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON only.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run what a table of the paper needs and print its figures and ours side by side.

    With --data on the real dataset; without it on a synthetic suite, which the caption says. Writes
    DIR/tables/TABLE.md, .csv and .json.
    """
    from tracking3d.benchmark.sequences import open_dataset
    from tracking3d.benchmark.table import fill, format_table, to_json, write_table
    from tracking3d.benchmark.table_plot import plot_table
    from tracking3d.benchmark.tables import TABLES
    from tracking3d.benchmark.variant import Variant
    from tracking3d.cli.evaluate.progress import jobs_progress, making_progress
    from tracking3d.cli.tables import print_table
    from tracking3d.speed.plot import check_plot

    if name not in TABLES:
        raise InputError(f"There is no table '{name}'; choose one of {', '.join(TABLES)}.")
    if plot:
        check_plot(plot)
    wanted = TABLES[name].only(rows or [])
    folders = dict(_named_folder(item) for item in initial or ())
    settings = configure(config, preset, overrides)
    base = Variant(label=name_of_settings(config, preset, overrides, "tracker"), config=settings)
    with making_progress(quiet) as made:
        dataset = open_dataset(wanted.dataset if data else suite, data, out, jobs, made).only(sequences or [])
    with jobs_progress(None, quiet) as listener:
        filled = fill(wanted, base, dataset, out, jobs, folders, listener)
    files = write_table(filled, out / "tables")
    if plot:
        plot_table(filled, plot)
    if as_json:
        typer.echo(to_json(filled), nl=False)
    elif not quiet:
        print_table(format_table(filled))
        typer.echo("\n".join(str(file) for file in files))


def _named_folder(item: str) -> tuple[str, Path]:
    name, equals, folder = item.partition("=")
    if not equals or not Path(folder).is_dir():
        raise InputError(f"--initial {item} names no folder that exists; write it as TRACKER=DIR.")
    return name.lower(), Path(folder)
