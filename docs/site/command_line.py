"""Writes docs/command-line.md from the help of the program; a test says when it has to be run again.

$ python docs/site/command_line.py
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from tracking3d.cli import app

PAGE = Path(__file__).resolve().parents[1] / "command-line.md"
IN_THE_HEAD = {"--help", "--debug", "--quiet"}
"""Options that mean the same in every command."""

HEAD = """# Command line

This page is what `tracking3d COMMAND --help` prints, as one page (`docs/site/command_line.py` makes it).

Every command takes `--help`, and `--debug`, which prints the traceback of an error too. Most take `--quiet` (`-q`),
which prints errors only. `tracking3d --version` prints the version, and `tracking3d --install-completion` sets up
completion in your shell.

`tracking3d batch JOBS` is short for `batch run`, and so are `calibrate SOURCE` for `calibrate video`,
`evaluate ANSWERS` for `evaluate answers` and `plugins` for `plugins list`.

Commands that take longer than a moment say on the standard error what they are doing, with a count and the time left:
on a terminal in a line that disappears at the end, elsewhere every ten seconds.

| exit code | |
|---|---|
| 0 | success |
| 1 | a bug in the program, or, for a command that processes many videos, a failure of one of them |
| 2 | bad input, or too little memory or disk space; the message says what to change, and finished frames are kept |
| 130 | interrupted, by Ctrl-C or SIGTERM; finished frames are kept |
| 141 | the output is piped into a program that has ended, as in `\\| head -1` |
"""


def command_line_page() -> str:
    """The whole page, as Markdown."""
    commands = typer.main.get_command(app).commands
    return "\n".join([HEAD, *(part for name, one in commands.items() for part in sections([name], one))])


def sections(path: list[str], command: Any) -> Iterator[str]:
    """Heading, usage, help and options of a command, and the same of the commands inside it."""
    inner = getattr(command, "commands", {})
    yield f"{'#' * (len(path) + 1)} {' '.join(path)}\n"
    if not inner:
        arguments = [one.metavar for one in command.params if not is_option(one)]
        yield f"`{' '.join(['tracking3d', *path, *arguments])}`\n"
    yield as_markdown(command.help or "") + "\n"
    context = command.context_class(command)
    shown = [one for one in command.params if not one.hidden and not IN_THE_HEAD & set(one.opts)]
    if rows := [row(one, context) for one in sorted(shown, key=is_option)]:
        yield "\n".join(["| | |", "|---|---|", *rows]) + "\n"
    for name, below in inner.items():
        yield from sections([*path, name], below)


def is_option(parameter: Any) -> bool:
    """Whether it is no argument."""
    return bool(parameter.param_type_name == "option")


def row(parameter: Any, context: Any) -> str:
    """A line of the table of a command's arguments and options."""
    names = [parameter.metavar]
    if is_option(parameter):
        kind = parameter.metavar or parameter.display_type(context).strip("<>").removesuffix(" range")
        value = "" if parameter.is_flag else f" {kind}"
        names = [f"{name}{value}" for name in (*parameter.opts, *parameter.secondary_opts)]
    default = f" Default: {parameter.show_default}." if isinstance(parameter.show_default, str) else ""
    cells = ", ".join(f"`{name}`" for name in names), as_markdown(parameter.help) + default
    return "| " + " | ".join(cell.replace("\n\n", " ").replace("|", "\\|") for cell in cells) + " |"


def as_markdown(text: str) -> str:
    """The paragraphs of a help text, each on a line, with what would be markup outside of code escaped."""
    paragraphs = (" ".join(one.split()) for one in re.split(r"\n\s*\n", text.replace("\b", "").strip()))
    pieces = re.split(r"(`[^`]*`)", "\n\n".join(paragraphs))
    return "".join(
        piece if piece.startswith("`") else piece.replace("<", "&lt;").replace("*", r"\*") for piece in pieces
    )


if __name__ == "__main__":
    PAGE.write_text(command_line_page(), encoding="utf-8")
