"""``tracking3d config``: show, describe and check configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, configure

app = typer.Typer(help="Show, describe and check configurations.", no_args_is_help=True)


@app.command()
def show(
    config: ConfigFile = None, preset: Preset = None, overrides: Overrides = None, debug: Debug = False
) -> None:
    """Print the whole configuration as YAML, with every default, as `run` would use it."""
    import yaml

    from tracking3d.plugins import FEATURES, TRACKERS, check_options

    settings = configure(config, preset, overrides)
    shown = settings.model_dump(mode="json")
    for section, group in (("tracker", TRACKERS), ("features", FEATURES)):
        choice = getattr(settings, section)
        shown[section] = {"name": choice.name, **check_options(group, choice).model_dump(mode="json")}
    typer.echo(yaml.safe_dump(shown, sort_keys=False, allow_unicode=True), nl=False)


@app.command()
def schema(debug: Debug = False) -> None:
    """Print the JSON schema of a configuration file."""
    import json

    from tracking3d.config.loading import config_schema

    typer.echo(json.dumps(config_schema(), indent=2))


@app.command()
def validate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Configuration file.")], debug: Debug = False
) -> None:
    """Check a configuration file, the options of its plug-ins included."""
    configure(file, None, None)
    typer.echo(f"{file} is valid")
