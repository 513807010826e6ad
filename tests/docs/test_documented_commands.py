"""Every command in the documentation is one that the program takes, and every option is documented."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator

import pytest
import typer
from documentation_pages import PAGES, ROOT, commands, label

from tracking3d.cli import app
from tracking3d.cli.options import configure

PROGRAM = typer.main.get_command(app)
DOCUMENTED = [(page, line) for page in PAGES for line in commands(page, "tracking3d")]


def leaves(
    command=PROGRAM, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], typer.core.TyperCommand]]:
    if not hasattr(command, "commands"):
        yield path, command
        return
    for name, inner in command.commands.items():
        yield from leaves(inner, (*path, name))


@pytest.mark.parametrize(("page", "line"), DOCUMENTED, ids=[f"{label(p)}: {c}" for p, c in DOCUMENTED])
def test_documented_command_is_understood(page, line):
    arguments = shlex.split(line)
    if arguments == ["--version"]:
        return
    command, context = PROGRAM, None
    while hasattr(command, "commands"):
        context = command.make_context(command.name, arguments, parent=context)
        name, command, arguments = command.resolve_command(context, arguments)
    given = command.make_context(name, arguments, parent=context).params
    # What is set must be valid too; the plug-ins of the examples need not be installed.
    if {"preset", "overrides"} <= given.keys() and given.get("tracker") in (None, "csrt"):
        config = given.get("config")
        configure(config and ROOT / config, given["preset"], given["overrides"])


@pytest.mark.parametrize(
    ("path", "command"), list(leaves()), ids=lambda value: " ".join(value) if isinstance(value, tuple) else ""
)
def test_every_option_is_documented(path, command):
    page = (ROOT / "docs/command-line.md").read_text(encoding="utf-8")
    section = re.search(rf"^## {path[0]}\b.*?(?=^## |\Z)", page, re.M | re.S)
    assert section, f"docs/command-line.md has no section on {path[0]}"
    options = {
        name
        for parameter in command.params
        for name in parameter.opts
        if name.startswith("--") and not getattr(parameter, "hidden", False)
    }
    missing = {
        name
        for name in options - {"--debug", "--help"}
        if f"`{name}" not in section[0] and f" {name} " not in section[0]
    }
    assert not missing


def test_documented_make_targets_exist():
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    typed = [shlex.split(line)[0] for page in PAGES for line in commands(page, "make")]
    assert typed
    assert set(typed) <= set(targets)
