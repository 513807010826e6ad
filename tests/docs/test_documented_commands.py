"""Every command in the documentation is one that the program takes, and every option is documented."""

from __future__ import annotations

import importlib.util
import re
import shlex

import pytest
import typer
from documentation_pages import PAGES, ROOT, commands, label

from tracking3d.cli import app
from tracking3d.cli.options import configure

PROGRAM = typer.main.get_command(app)
DOCUMENTED = [(page, line) for page in PAGES for line in commands(page, "tracking3d")]


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


@pytest.mark.skipif(
    f"typer=={typer.__version__}\n" not in (ROOT / "constraints.txt").read_text(encoding="utf-8"),
    reason="versions of typer describe types of values differently; the page is made with the pinned one",
)
def test_the_command_line_page_is_what_the_program_prints():
    specification = importlib.util.spec_from_file_location("command_line", ROOT / "docs/site/command_line.py")
    script = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(script)
    for page, text in script.pages().items():
        assert page.read_text(encoding="utf-8") == text, "make it again: python docs/site/command_line.py"


def test_documented_make_targets_exist():
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    typed = [shlex.split(line)[0] for page in PAGES for line in commands(page, "make")]
    assert typed
    assert set(typed) <= set(targets)
