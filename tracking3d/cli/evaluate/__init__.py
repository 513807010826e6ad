"""``tracking3d evaluate``: score answers, run suites, fill the paper's tables, compare.

``tracking3d evaluate ANSWERS --truth CLIP`` is short for ``tracking3d evaluate answers ANSWERS --truth CLIP``.
"""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from tracking3d.cli.evaluate import answers, compare, peer, spread, suite, table

DEFAULT = "answers"


class _Evaluate(TyperGroup):
    """A group whose first word may be left out: what names no command is what is to be scored."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in self.commands and args[0] not in ("--help", "--debug"):
            args = [DEFAULT, *args]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        return super().resolve_command(ctx, args if args[0] in self.commands else [DEFAULT, *args])


app = typer.Typer(
    cls=_Evaluate,
    help="Score answers against the truth, run suites, fill the paper's tables, compare.",
    no_args_is_help=True,
)
app.command(name=DEFAULT)(answers.score_answers)
app.command(name="suite")(suite.suite)
app.command(name="table")(table.table)
app.command(name="compare")(compare.compare)
app.command(name="spread")(spread.spread)
app.command(name="peer")(peer.peer)
