"""``tracking3d bench``: how fast, and how good by themselves, the parts are on this machine."""

from __future__ import annotations

import typer

from tracking3d_bench.cli.bench import live, masks, matching, points, render, track

app = typer.Typer(
    help="Measure how fast, and how good by themselves, the parts are on this machine.",
    no_args_is_help=True,
    add_completion=False,
)
app.command(name="render")(render.render)
app.command(name="track")(track.track)
app.command(name="live")(live.live)
app.command(name="masks")(masks.masks)
app.command(name="matching")(matching.matching)
app.command(name="points")(points.points)
