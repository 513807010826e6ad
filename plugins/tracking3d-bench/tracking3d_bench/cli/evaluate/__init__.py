"""``tracking3d evaluate``: score estimates, run suites, fill the paper's tables, compare.

``tracking3d evaluate ANSWERS --truth CLIP`` is short for ``tracking3d evaluate answers ANSWERS --truth CLIP``.
"""

from __future__ import annotations

import typer

from tracking3d.cli.program import WithDefault
from tracking3d_bench.cli.evaluate import answers, compare, model, peer, spread, suite, table

DEFAULT = "answers"


class _Evaluate(WithDefault):
    default = DEFAULT


app = typer.Typer(
    cls=_Evaluate,
    help="Score estimates against the ground truth, run suites, fill the paper's tables, compare.",
    no_args_is_help=True,
    add_completion=False,
)
app.command(name=DEFAULT)(answers.score_answers)
app.command(name="model")(model.score_models)
app.command(name="suite")(suite.suite)
app.command(name="table")(table.table)
app.command(name="compare")(compare.compare)
app.command(name="spread")(spread.spread)
app.command(name="peer")(peer.peer)
