"""Commands of other packages, which register them in the entry-point group ``tracking3d.commands``.

The entry point's name is the command's, and its value a `typer.Typer` with ``add_completion=False``. Whoever writes one
imports what takes long when the command is called: ``--help`` asks each for its help.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import metadata
from typing import Any

import typer

from tracking3d.errors import InputError, PluginError
from tracking3d.runtime.moved_modules import bench_is_missing

COMMANDS = "tracking3d.commands"
"""Entry-point group of the commands."""

_MEASURING = {"bench", "evaluate", "synth"}
"""Commands of this repository's distribution ``tracking3d-bench``."""


def registered_commands() -> Mapping[str, metadata.EntryPoint]:
    """By name; of two with the same name the first by its package."""
    points = metadata.entry_points(group=COMMANDS)
    return {point.name: point for point in sorted(points, key=_package, reverse=True)}


def fault_of(point: metadata.EntryPoint) -> str:
    """Why a command cannot be loaded, in a clause; empty if it can."""
    try:
        value = point.load()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "" if isinstance(value, typer.Typer) else f"{point.value} is not a typer.Typer"


def plugged_command(name: str) -> Any:
    """The command of another package, one of click's as typer brings it along; None if no package has it.

    Raises:
        PluginError: It cannot be loaded.
        InputError: It belongs to the distribution ``tracking3d-bench``, which is not installed.
    """
    point = registered_commands().get(name)
    if point is None:
        if name in _MEASURING:
            raise InputError(bench_is_missing(f"The command {name}"))
        return None
    if fault := fault_of(point):
        raise PluginError(f"The command {name} ({_package(point)}) is broken: {fault}.")
    command = typer.main.get_command(point.load())
    command.name = name
    return command


def _package(point: metadata.EntryPoint) -> str:
    return point.dist.name if point.dist else ""
