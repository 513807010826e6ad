"""``tracking3d config``: show, describe and check configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tracking3d.cli.options import ConfigFile, Debug, Overrides, Preset, Quality, configure

app = typer.Typer(help="Show, describe and check configurations.", no_args_is_help=True)


@app.command()
def show(
    config: ConfigFile = None,
    preset: Preset = None,
    quality: Quality = None,
    overrides: Overrides = None,
    debug: Debug = False,
) -> None:
    """Print the complete configuration as YAML, with every default, as `run` would use it.

    The standard error lists what preset, quality and file change.
    """
    import yaml

    from tracking3d.config.loading import layers_in_words
    from tracking3d.config.models import AUTO
    from tracking3d.plugins import FEATURES, KEYPOINTS, TRACKERS, check_options

    settings = configure(config, preset, overrides, quality)
    shown = settings.model_dump(mode="json")
    for section, group in (("tracker", TRACKERS), ("features", FEATURES), ("keypoints", KEYPOINTS)):
        choice = getattr(settings, section)
        if section == "tracker" and choice.name == AUTO:
            continue  # the video decides which one
        shown[section] = {"name": choice.name, **check_options(group, choice).model_dump(mode="json")}
    for words in layers_in_words(config, preset, quality):
        typer.echo(f"# {words}", err=True)
    typer.echo(yaml.safe_dump(shown, sort_keys=False, allow_unicode=True), nl=False)


@app.command()
def schema(debug: Debug = False) -> None:
    """Print the JSON schema of a configuration file."""
    import json

    from tracking3d.config.loading import config_schema

    typer.echo(json.dumps(config_schema(), indent=2))


@app.command("list")
def list_files(debug: Debug = False) -> None:
    """List the configuration files that come with tracking3d; --config takes their names."""
    from tracking3d.config.loading import ready_files

    for name, file in ready_files().items():
        typer.echo(f"{name}: {file.read_text(encoding='utf-8').partition(chr(10))[0].lstrip('# ')}")


@app.command()
def path(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of a file, as `config list` prints it.")],
    debug: Debug = False,
) -> None:
    """Print the path of a configuration file that comes with tracking3d."""
    from tracking3d.config.explain import hint
    from tracking3d.config.loading import ready_files
    from tracking3d.errors import InputError

    files = ready_files()
    if name not in files:
        raise InputError(f"There is no configuration file named '{name}'; {hint(name, files)}")
    typer.echo(files[name])


@app.command()
def validate(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Configuration file.")], debug: Debug = False
) -> None:
    """Check a configuration file, including the options of its plug-ins."""
    configure(file, None, None)
    typer.echo(f"{file} is valid")
