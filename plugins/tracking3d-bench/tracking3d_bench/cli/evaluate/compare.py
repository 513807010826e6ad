"""``tracking3d evaluate compare``: is B better than A?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tracking3d.cli.options import AsJson, Debug, Quiet, configure
from tracking3d.cli.options.general import DATA, Sequences
from tracking3d.errors import InputError
from tracking3d_bench.cli.evaluate.options import Data, Jobs, Masks, Out

if TYPE_CHECKING:
    from tracking3d_bench.benchmark.variant import Variant


def compare(
    a: Annotated[
        str,
        typer.Argument(
            metavar="A", help="Result file of `evaluate suite` (.json), a configuration file, or a preset."
        ),
    ],
    b: Annotated[str, typer.Argument(metavar="B", help="The same, to compare with A.")],
    suite: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Dataset to run configurations on; see `evaluate suite`.",
            rich_help_panel=DATA,
        ),
    ] = "standard",
    data: Data = None,
    masks: Masks = "tracker",
    sequences: Sequences = None,
    out: Out = Path("benchmark"),
    jobs: Jobs = 1,
    as_json: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Compare two sets of results, or two configurations, sequence by sequence.

    Prints the mean difference of every measure, with its 95 % confidence interval over the sequences.
    """
    import json
    from dataclasses import asdict

    from tracking3d.cli.tables import print_table
    from tracking3d_bench.benchmark.compare import compare as compare_results
    from tracking3d_bench.benchmark.compare import format_comparison
    from tracking3d_bench.benchmark.results import read_results
    from tracking3d_bench.benchmark.sequences import open_dataset
    from tracking3d_bench.benchmark.suite import run_suite
    from tracking3d_bench.cli.evaluate.progress import jobs_progress, making_progress

    given = [a.lower().endswith(".json"), b.lower().endswith(".json")]
    if all(given):
        of_a, of_b = read_results(Path(a)), read_results(Path(b))
    elif any(given):
        raise InputError("Give two result files or two configurations, not one of each.")
    else:
        variants = [_variant(name, masks) for name in (a, b)]
        with making_progress(quiet) as made:
            dataset = open_dataset(suite, data, out, jobs, made).only(sequences or [])
        with jobs_progress(2 * len(dataset.sequences), quiet) as listener:
            of_a, of_b = run_suite(variants, dataset, out, jobs, listener)
    comparisons = compare_results(of_a, of_b)
    if as_json:
        typer.echo(json.dumps([asdict(one) | {"verdict": one.verdict} for one in comparisons], indent=2))
        return
    for table in format_comparison(comparisons, of_a, of_b):
        print_table(table)


def _variant(name: str, masks: str) -> Variant:
    from tracking3d_bench.benchmark.variant import Variant

    file = Path(name)
    is_file = file.suffix in (".yaml", ".yml")
    settings = configure(file, None, None) if is_file else configure(None, name, None)
    return Variant(label=file.stem if is_file else name, config=settings, masks=masks)
