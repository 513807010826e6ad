"""``tracking3d evaluate suite``: run and score every sequence of a dataset, in parallel."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quality, Quiet, configure
from tracking3d.cli.options.general import Sequences
from tracking3d.cli.options.output import Address
from tracking3d_bench.cli.evaluate.options import Data, Jobs, Masks, Out, name_of_settings
from tracking3d_bench.cli.fresh import Count, Meshes, draw_suite


def suite(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME",
            help="Dataset: smoke, standard, hard, full, fresh or phone (synthetic), real, the name of a dataset "
            "layout, or a YAML file with one.",
        ),
    ],
    seed: Annotated[
        int | None, typer.Option(metavar="N", help="Random seed of the suites 'fresh' and 'phone'.")
    ] = None,
    count: Count = None,
    meshes: Meshes = None,
    data: Data = None,
    masks: Masks = "tracker",
    sequences: Sequences = None,
    label: Annotated[str | None, typer.Option(metavar="NAME", help="Label of the results in tables.")] = None,
    config: ConfigFile = None,
    preset: Preset = None,
    quality: Quality = None,
    overrides: Overrides = None,
    out: Out = Path("benchmark"),
    jobs: Jobs = 1,
    address: Address = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print only the path of the result file.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run and score every sequence of a dataset; finished sequences are not run again.

    Writes the scores to DIR/results/LABEL-NAME.json, and keeps the runs in DIR/runs.
    """
    settings = configure(config, preset, overrides, quality)
    from tracking3d.cli.tables import print_table
    from tracking3d_bench.benchmark.results import format_results, write_results
    from tracking3d_bench.benchmark.sequences import open_dataset
    from tracking3d_bench.benchmark.suite import run_suite
    from tracking3d_bench.benchmark.table import file_name
    from tracking3d_bench.benchmark.variant import Variant, check_masks
    from tracking3d_bench.cli.evaluate.progress import jobs_progress, making_progress

    check_masks(masks)
    name, specs = draw_suite(name, seed, count, meshes)
    called = label or name_of_settings(config, quality or preset, overrides, masks)
    variant = Variant(label=called, config=settings, masks=masks)
    with making_progress(quiet) as made:
        dataset = open_dataset(name, data, out, jobs, made, specs).only(sequences or [])
    with jobs_progress(len(dataset.sequences), quiet) as listener:
        [results] = run_suite([variant], dataset, out, jobs, listener, address)
    file = out / "results" / f"{file_name(called)}-{dataset.name}.json"
    write_results(results, file)
    if as_json:
        typer.echo(file)
    elif not quiet:
        for one in results.split():
            print_table(format_results(one))
        typer.echo(file)
    for sequence, error in results.errors.items():
        typer.echo(f"{sequence} failed: {error}", err=True)
    if results.errors:
        raise typer.Exit(1)
