"""``tracking3d evaluate table``: the paper's tables, with our figures next to its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import AsJson, ConfigFile, Debug, Overrides, Preset, Quiet, configure
from tracking3d.cli.options.general import DATA, OUTPUT, Sequences
from tracking3d.cli.options.output import Address
from tracking3d.errors import InputError
from tracking3d_bench.cli.evaluate.options import Data, Jobs, Masks, Out, name_of_settings

if TYPE_CHECKING:
    from rich.table import Table

    from tracking3d_bench.benchmark.pool import Listener
    from tracking3d_bench.benchmark.sequences import Dataset
    from tracking3d_bench.benchmark.tables import Table as PaperTable
    from tracking3d_bench.benchmark.variant import Variant


Name = Annotated[
    str,
    typer.Argument(
        metavar="TABLE",
        help="cdtb, inhand, coin, ablation, features, bop or keyframes; or online, which compares the solvers.",
    ),
]
Suite = Annotated[
    str,
    typer.Option(
        metavar="NAME", help="Synthetic suite that is used if --data is left out.", rich_help_panel=DATA
    ),
]
Initial = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TRACKER=DIR",
        help="Masks of a tracker, with a folder for each sequence; may be repeated.",
        rich_help_panel=DATA,
    ),
]
Rows = Annotated[
    list[str] | None,
    typer.Option("--row", metavar="PATTERN", help="Fill only rows whose name matches; may be repeated."),
]
Plot = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Draw the table as .svg, .png or .pdf too.", rich_help_panel=OUTPUT),
]


def table(
    name: Name,
    data: Data = None,
    suite: Suite = "standard",
    initial: Initial = None,
    rows: Rows = None,
    masks: Masks = "tracker",
    sequences: Sequences = None,
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    plot: Plot = None,
    out: Out = Path("benchmark"),
    jobs: Jobs = 1,
    address: Address = None,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run what a table of the paper needs, and print the paper's figures and ours side by side.

    With --data the real dataset is used, otherwise a synthetic suite; the caption says which. Writes
    DIR/tables/TABLE.md, .csv and .json. Only the table online takes --masks, and with --data clips in this project's
    layout; the rows of the other tables define their masks.
    """
    from tracking3d_bench.benchmark import solver_table
    from tracking3d_bench.benchmark.sequences import REAL, open_dataset
    from tracking3d_bench.benchmark.tables import TABLES
    from tracking3d_bench.benchmark.variant import Variant, check_masks
    from tracking3d_bench.cli.evaluate.progress import jobs_progress, making_progress
    from tracking3d_bench.speed.plot import check_plot

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
    # The paper's tables vary settings that only its solver has.
    settings = configure(config, preset or (None if config or of_solvers else "rerendering"), overrides)
    label = name_of_settings(config, preset, overrides, "tracker")
    base = Variant(label=label, config=settings, masks=masks)
    real = REAL if of_solvers else TABLES[name].dataset
    with making_progress(quiet) as made:
        dataset = open_dataset(real if data else suite, data, out, jobs, made).only(sequences or [])
    with jobs_progress(None, quiet) as listener:
        if of_solvers:
            filled = _fill_solver_table(base, dataset, out, rows or [], jobs, listener, address)
        else:
            wanted = TABLES[name].only(rows or [])
            filled = _fill_paper_table(wanted, base, dataset, out, jobs, folders, listener, address, plot)
    _print(filled, as_json, quiet)


@dataclass(frozen=True)
class _Filled:
    """A filled table: the files written, its JSON, and what is printed."""

    files: Sequence[Path]
    json: str
    tables: Sequence[Table]


def _fill_solver_table(
    base: Variant,
    dataset: Dataset,
    out: Path,
    rows: list[str],
    jobs: int,
    listener: Listener,
    address: str | None,
) -> _Filled:
    from tracking3d_bench.benchmark import solver_table

    filled = solver_table.fill(base, dataset, out, rows, jobs, listener, address)
    files = solver_table.write_table(filled, out / "tables")
    return _Filled(files, solver_table.to_json(filled), solver_table.format_table(filled))


def _fill_paper_table(
    wanted: PaperTable,
    base: Variant,
    dataset: Dataset,
    out: Path,
    jobs: int,
    folders: dict[str, Path],
    listener: Listener,
    address: str | None,
    plot: Path | None,
) -> _Filled:
    from tracking3d_bench.benchmark.table import fill, format_table, to_json, write_table
    from tracking3d_bench.benchmark.table_plot import plot_table

    filled = fill(wanted, base, dataset, out, jobs, folders, listener, address)
    files = write_table(filled, out / "tables")
    if plot:
        plot_table(filled, plot)
    return _Filled(files, to_json(filled), [format_table(filled)])


def _print(filled: _Filled, as_json: bool, quiet: bool) -> None:
    from tracking3d.cli.tables import print_table

    if as_json:
        typer.echo(filled.json, nl=False)
    elif not quiet:
        for one in filled.tables:
            print_table(one)
        typer.echo("\n".join(str(file) for file in filled.files))


def _check_options(name: str, of_solvers: bool, of_papers: dict[str, object], masks: str) -> None:
    """Refuse options that only the other kind of table has."""
    given = next((option for option, value in of_papers.items() if value), None)
    if of_solvers and given:
        raise InputError(f"Table {name} takes no {given}; leave it out.")
    if not of_solvers and masks != "tracker":
        raise InputError(f"Table {name} takes no --masks: each of its rows defines its masks; leave it out.")


def _named_folder(item: str) -> tuple[str, Path]:
    name, equals, folder = item.partition("=")
    if not equals or not Path(folder).is_dir():
        raise InputError(f"--initial {item} names no existing folder; write it as TRACKER=DIR.")
    return name.lower(), Path(folder)
