"""``tracking3d evaluate spread``: how much estimates vary if they should be equal."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quiet, configure
from tracking3d.cli.options.general import Sequences
from tracking3d.errors import InputError
from tracking3d_bench.cli.evaluate.options import Data, Jobs, Masks, Out, name_of_settings


def spread(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Dataset, as for `evaluate suite`.")] = "smoke",
    data: Data = None,
    masks: Masks = "tracker",
    sequences: Sequences = None,
    patterns: Annotated[
        list[str] | None,
        typer.Option(
            "--variant",
            metavar="PATTERN",
            help="Run only variants whose name matches, besides the unchanged one; may be repeated.",
        ),
    ] = None,
    vary: Annotated[
        str,
        typer.Option(
            metavar="computation|input",
            help="What differs: the processor's kernels and the renderer, or the first box, the first frame and the "
            "given lens.",
        ),
    ] = "computation",
    config: ConfigFile = None,
    preset: Preset = None,
    overrides: Overrides = None,
    out: Out = Path("benchmark"),
    jobs: Jobs = 1,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Measure how much estimates vary with the processor and tiny noise, or with small changes of the input.

    Prints mean, spread and worst case of every measure, and which sequences some variants track and others lose. Writes
    DIR/tables/spread-NAME-MASKS.md and .json, or spread-NAME-MASKS-input with --vary input; runs are kept in DIR/runs
    and are not repeated.
    """
    from tracking3d.cli.tables import print_table
    from tracking3d_bench.benchmark.sequences import open_dataset
    from tracking3d_bench.benchmark.spread import describe_flips, format_spreads, run_spread, write_spreads
    from tracking3d_bench.benchmark.spread_variants import Vary
    from tracking3d_bench.benchmark.table import file_name
    from tracking3d_bench.benchmark.variant import Variant, check_masks
    from tracking3d_bench.cli.evaluate.progress import jobs_progress, making_progress

    if vary not in list(Vary):
        raise InputError(f"--vary {vary} is unknown; give {' or '.join(Vary)}.")
    check_masks(masks)
    settings = configure(config, preset, overrides)
    base = Variant(label=name_of_settings(config, preset, overrides, "tracker"), config=settings, masks=masks)
    with making_progress(quiet) as made:
        dataset = open_dataset(name, data, out, jobs, made).only(sequences or [])
    with jobs_progress(None, quiet) as listener:
        results, left_out = run_spread(base, dataset, out, patterns or [], Vary(vary), jobs, listener)
    failed = {f"{sequence} ({one.label})": why for one in results for sequence, why in one.errors.items()}
    for what, why in failed.items():
        typer.echo(f"{what} failed: {why}", err=True)
    title = f"{dataset.name} ({len(dataset.sequences)} sequences): {base.label}, masks {masks}"
    suffix = "" if vary == Vary.COMPUTATION else f"-{vary}"
    file = out / "tables" / f"spread-{dataset.name}-{file_name(Path(masks).name)}{suffix}"
    files = write_spreads(results, left_out, title, file)
    if not quiet:
        for one in format_spreads(results, title):
            print_table(one)
        typer.echo(describe_flips(results))
        for label, why in left_out.items():
            typer.echo(f"Not run: {label}, {why}.")
        typer.echo("\n".join(str(file) for file in files))
    if failed:
        raise typer.Exit(1)
