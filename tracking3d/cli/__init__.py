"""The command line: parse, call, print.

Each command has a file, and imports what it needs when it is called. So ``--help`` is quick. Other packages add
commands of their own, see `tracking3d.cli.plugged_commands`.
"""

from __future__ import annotations

import ctypes
import os
from contextlib import suppress

import typer

from tracking3d.cli import (
    batch,
    calibrate,
    compare,
    config,
    correct,
    demo,
    export,
    model,
    models,
    pick,
    plugins,
    points,
    report,
    run,
    view,
)
from tracking3d.cli.options import Debug
from tracking3d.cli.program import Program

app = typer.Typer(
    name="tracking3d",
    cls=Program,
    help="Track a rigid object in an ordinary RGB video: masks, poses and a textured mesh.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.command(name="run")(run.run)
app.command(name="demo")(demo.demo)
app.command(name="pick")(pick.pick)
app.command(name="view")(view.view)
app.command(name="correct")(correct.correct)
app.command(name="points")(points.points)
app.command(name="model")(model.model)
app.command(name="export")(export.export)
app.command(name="report")(report.report)
app.command(name="compare")(compare.compare)
app.add_typer(batch.app, name="batch")
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(models.app, name="models")
app.add_typer(plugins.app, name="plugins")
app.add_typer(config.app, name="config")


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata

        typer.echo(f"tracking3d {metadata.version('tracking3d')}")
        raise typer.Exit


@app.callback()
def _root(
    version: bool = typer.Option(
        False, "--version", is_eager=True, callback=_print_version, help="Print the version and exit."
    ),
    debug: Debug = False,
) -> None:
    pass


def main() -> None:
    """Entry point of the console script."""
    # Matrices are small here: the threads of OpenBLAS, by default one per core, would wait longer than they work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _share_heaps()
    app()


_ARENAS, _MMAP_THRESHOLD, _TRIM_THRESHOLD = -8, -3, -1  # M_ARENA_MAX and others in glibc's malloc.h
# And bytes (measured): 4 MB save 40 MB more, and the shape takes a third longer.
_HEAPS, _LARGE = 2, 32 << 20


def _share_heaps() -> None:
    """Let all threads share two heaps of the C library: with one each, a run takes an eighth more memory."""
    if "MALLOC_ARENA_MAX" in os.environ:
        return
    with suppress(OSError, AttributeError, TypeError):  # C libraries other than glibc
        set_option = ctypes.CDLL(None).mallopt
        for option, value in ((_ARENAS, _HEAPS), (_MMAP_THRESHOLD, _LARGE), (_TRIM_THRESHOLD, _LARGE)):
            set_option(option, value)
