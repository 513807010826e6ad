"""``tracking3d plugins``: the mask trackers and feature encoders that are installed."""

from __future__ import annotations

from typing import Annotated

import typer

from tracking3d.cli.options import Debug


def plugins(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON only, with the schema of the options.")
    ] = False,
    debug: Debug = False,
) -> None:
    """List the mask trackers and feature encoders that are installed, and what is wrong with a broken one."""
    import json
    from dataclasses import asdict

    from tracking3d.plugins import list_plugins

    infos = list_plugins()
    if as_json:
        typer.echo(json.dumps([asdict(info) for info in infos], indent=2))
        return
    from rich.markup import escape
    from rich.table import Table

    from tracking3d.cli.tables import print_table

    table = Table("name", "group", "package", "version", "status", "reason")
    for info in infos:
        cells = (info.name, info.group, info.package, info.version, info.status, info.reason)
        table.add_row(*map(escape, cells))
    print_table(table)
