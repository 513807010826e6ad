"""``tracking3d batch status DIR``: progress of a batch, on any machine that can read its folder."""

from __future__ import annotations

from typing import Annotated

import typer

from tracking3d.cli.options import AsJson, Debug


def status(
    folder: Annotated[str, typer.Argument(metavar="DIR", help="Folder of the batch, its --out.")],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Print the progress of the batch in DIR: its state, the time left, and which videos failed and why."""
    import json
    from dataclasses import asdict

    from rich.markup import escape
    from rich.table import Table

    from tracking3d.batch.folder import read_failures, read_progress
    from tracking3d.batch.places import absolute
    from tracking3d.cli.batch.progress import in_words
    from tracking3d.cli.tables import print_table

    place = absolute(folder)
    progress, failures = read_progress(place), read_failures(place)
    if as_json:
        document = {**asdict(progress), "failures": [asdict(one) for one in failures]}
        typer.echo(json.dumps(document, indent=2))
        return
    table = Table(
        title=escape(f"{folder} ({progress.state_in_words})"), show_header=False, title_justify="left"
    )
    table.add_row("videos", in_words(progress))
    table.add_row("engine", f"{progress.engine}, {progress.workers} at a time")
    for worker, about in progress.running.items():
        of = f" of {about['of']}" if about.get("of") else ""
        step = f", {about['step']}" if about.get("step") else ""
        table.add_row(escape(worker), escape(f"{about['video']}{step}: {about.get('frames', 0)}{of} frames"))
    for one in failures:
        table.add_row("failed", escape(f"{one.run}: {one.reason}"))
    print_table(table)
