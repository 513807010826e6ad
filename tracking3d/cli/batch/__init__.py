"""``tracking3d batch``: many videos, each in a worker, on this machine or on a Ray cluster.

``tracking3d batch JOBS --out DIR`` is short for ``tracking3d batch run JOBS --out DIR``.
"""

from __future__ import annotations

import typer

from tracking3d.cli.batch import run, status
from tracking3d.cli.program import WithDefault


class _Batch(WithDefault):
    default = "run"


app = typer.Typer(
    cls=_Batch,
    help="Track many videos, on this machine or on a Ray cluster, and show the progress.",
    no_args_is_help=True,
)
app.command(name="run")(run.run)
app.command(name="status")(status.status)
