"""``tracking3d batch``: many videos, each in a worker, on this machine or on a Ray cluster.

``tracking3d batch JOBS --out DIR`` is short for ``tracking3d batch run JOBS --out DIR``.
"""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from tracking3d.cli.batch import run, status


class WithDefault(TyperGroup):
    """A group whose default command need not be named."""

    default: str

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command if the first word names none."""
        if args and args[0] not in self.commands and args[0] not in ("--help", "--debug"):
            args = [self.default, *args]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that the first word names, or the default one."""
        return super().resolve_command(ctx, args if args[0] in self.commands else [self.default, *args])


class _Batch(WithDefault):
    default = "run"


app = typer.Typer(
    cls=_Batch,
    help="Track many videos, on this machine or on a Ray cluster, and show the progress.",
    no_args_is_help=True,
)
app.command(name="run")(run.run)
app.command(name="status")(status.status)
