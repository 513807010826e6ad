"""Progress of the commands of ``tracking3d evaluate``, while sequences are rendered and run."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from tracking3d_bench.benchmark.pool import JobOutcome, Listener


@contextmanager
def making_progress(quiet: bool) -> Iterator[Callable[[str], None]]:
    """Print each rendered sequence of a suite on the standard error; yields the listener."""
    yield (lambda name: None) if quiet else (lambda name: typer.echo(f"rendered {name}", err=True))


@contextmanager
def jobs_progress(count: int | None, quiet: bool) -> Iterator[Listener]:
    """A bar over all jobs and a line for each as it is done, on the standard error; yields the listener."""
    console = Console(stderr=True)
    columns = BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("sequences"), TimeElapsedColumn()
    bar = Progress(*columns, console=console, disable=quiet or not console.is_terminal, transient=True)
    task = bar.add_task("", total=count)

    def listener(outcome: JobOutcome) -> None:
        bar.update(task, advance=1)
        if not quiet:
            bar.console.print(escape(_line(outcome)), highlight=False, soft_wrap=True)

    with bar:
        yield listener


def _line(outcome: JobOutcome) -> str:
    what = f"{outcome.job.sequence} ({outcome.job.variant.label})"
    if outcome.scores is None:
        return f"{what} failed: {outcome.error}"
    scores = outcome.scores
    parts = [f"IoU {scores['iou_mean']:.3f}"] if scores["iou_mean"] is not None else []
    if scores["rotation_error_mean_deg"] is not None:
        parts.append(f"rotation {scores['rotation_error_mean_deg']:.1f} degrees")
    took = "from an earlier run" if outcome.cached else f"{outcome.seconds:.0f} s"
    return f"{what}: {', '.join([*parts, took])}"
