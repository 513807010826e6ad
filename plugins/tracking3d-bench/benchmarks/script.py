"""How the scripts of this folder are called: options as those of ``tracking3d``, errors in one sentence."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable

import typer

from tracking3d.errors import Tracking3dError


def as_program(command: Callable[..., None]) -> typer.Typer:
    """A command line of one command; an error of the package is printed as a sentence, and the exit code is 2."""

    @functools.wraps(command)
    def ended_in_a_sentence(*given: object, **named: object) -> None:
        try:
            command(*given, **named)
        except Tracking3dError as error:
            typer.echo(f"error: {error.at_the_command_line}", err=True)
            raise typer.Exit(2) from error

    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(ended_in_a_sentence)
    return app


def run(command: Callable[..., None]) -> None:
    """Run a script's command with what ``sys.argv`` says."""
    # As in `tracking3d.cli.main`: the threads of OpenBLAS wait for one another longer than they work.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    as_program(command)()
