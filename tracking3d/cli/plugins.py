"""``tracking3d plugins``: list the installed mask trackers, feature encoders and commands, or create a
new plug-in.

``tracking3d plugins`` alone is short for ``tracking3d plugins list``.
"""

from __future__ import annotations

import shlex
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import Debug
from tracking3d.cli.plugged_commands import COMMANDS, fault_of, registered_commands
from tracking3d.cli.program import WithDefault

DEFAULT = "list"


class _Plugins(WithDefault):
    """A group that lists the plug-ins if no command is given."""

    default = DEFAULT

    def with_command(self, args: list[str]) -> list[str]:
        named = args[:1] == ["--help"] or (args and not args[0].startswith("-"))
        return args if named else [DEFAULT, *args]


app = typer.Typer(
    cls=_Plugins,
    help="List the installed plug-ins and commands, or create a new plug-in.",
)


class _Kind(StrEnum):
    TRACKER = "tracker"
    FEATURES = "features"
    KEYPOINTS = "keypoints"


@app.command(name=DEFAULT)
def plugins(
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON only, with the schema of each plug-in's options.")
    ] = False,
    debug: Debug = False,
) -> None:
    """List the installed plug-ins and commands, and say what is wrong with those that cannot run."""
    import json
    from dataclasses import asdict

    from tracking3d.plugins import PluginInfo, list_plugins

    infos = list_plugins(build=True)
    for name, point in sorted(registered_commands().items()):
        package, version = (point.dist.name, point.dist.version) if point.dist else ("unknown", "")
        fault = fault_of(point)
        infos.append(PluginInfo(name, COMMANDS, package, version, "broken" if fault else "ok", fault))
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


@app.command()
def new(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="Name of the plug-in, as --tracker or --features will take it."),
    ],
    kind: Annotated[
        _Kind, typer.Option(help="What it is: mask tracker, feature encoder or keypoint detector.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder in which the package's folder is created.")
    ] = Path(),
    debug: Debug = False,
) -> None:
    """Create a package with a new plug-in, ready to install: pyproject, module, test and README."""
    from tracking3d.plugins.template import write_plugin

    folder = write_plugin(name, kind.value, out)
    # Without a separator pip would look for the name on the package index.
    place = shlex.quote(str(folder) if len(folder.parts) > 1 else f"./{folder}")
    typer.echo(f"Wrote {folder}. Next: pip install {place} pytest && pytest {place}")
