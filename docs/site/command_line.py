"""Writes docs/command-line.md from the help of the program; a test says when it has to be run again.

The commands with which trackers are measured, of tracking3d-bench, have a page beside the scripts for that.

$ python docs/site/command_line.py
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from tracking3d.cli import app

ROOT = Path(__file__).resolve().parents[2]
MEASURING = ("synth", "evaluate", "bench")
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

`synth`, `evaluate` and `bench`, with which trackers are measured, are on
[a page of tracking3d-bench](../plugins/tracking3d-bench/benchmarks/command-line.md), the distribution that has them;
[measures](../plugins/tracking3d-bench/benchmarks/measures.md) begins with them.

| exit code | |
|---|---|
| 0 | success |
| 1 | a bug in the program, or, for a command that processes many videos, a failure of one of them |
| 2 | bad input, or too little memory or disk space; the message says what to change, and finished frames are kept |
| 130 | interrupted, by Ctrl-C or SIGTERM; finished frames are kept |
| 141 | the output is piped into a program that has ended, as in `\\| head -1` |
"""

MEASURING_HEAD = """# Commands that measure

What `tracking3d synth`, `evaluate` and `bench` print with `--help`, as one page (`docs/site/command_line.py` makes it).
[The command line](../../../docs/command-line.md) has all others, and what holds for every command.
"""


def pages() -> dict[Path, str]:
    """Every page that is made here, as Markdown."""
    program = typer.main.get_command(app)
    commands = {name: program.get_command(None, name) for name in program.list_commands(None)}
    known = set(rows_of(commands["run"]))
    used, measuring = (
        [
            part
            for name, one in commands.items()
            if (name in MEASURING) == chosen
            for part in sections([name], one, known)
        ]
        for chosen in (False, True)
    )
    return {
        ROOT / "docs/command-line.md": "\n".join([HEAD, *used]),
        ROOT / "plugins/tracking3d-bench/benchmarks/command-line.md": "\n".join([MEASURING_HEAD, *measuring]),
    }


def sections(path: list[str], command: Any, known: set[tuple[str, str]]) -> Iterator[str]:
    """Heading, usage, help and options of a command, and the same of the commands inside it.

    Args:
        path: The words after `tracking3d`.
        command: The command, one of click's as typer brings it along.
        known: The options of `run`: another command that has the same ones only names them.
    """
    inner = getattr(command, "commands", {})
    yield f"{'#' * (len(path) + 1)} {' '.join(path)}\n"
    if not inner:
        arguments = [one.metavar for one in command.params if not is_option(one)]
        yield f"`{' '.join(['tracking3d', *path, *arguments])}`\n"
    yield as_markdown(command.help or "") + "\n"
    rows = [one for one in rows_of(command) if path == ["run"] or one not in known]
    shared = [names for names, meaning in rows_of(command) if path != ["run"] and (names, meaning) in known]
    if shared:
        rows.append((", ".join(shared), "As for `run`."))
    if rows:
        yield (
            "\n".join(["| | |", "|---|---|", *(f"| {names} | {meaning} |" for names, meaning in rows)]) + "\n"
        )
    for name, below in inner.items():
        yield from sections([*path, name], below, known)


def is_option(parameter: Any) -> bool:
    """Whether it is no argument."""
    return bool(parameter.param_type_name == "option")


def rows_of(command: Any) -> list[tuple[str, str]]:
    """The arguments and options of a command, each with its meaning, as cells of a table."""
    context = command.context_class(command)
    shown = [one for one in command.params if not one.hidden and not IN_THE_HEAD & set(one.opts)]
    return [cells(one, context) for one in sorted(shown, key=is_option)]


def cells(parameter: Any, context: Any) -> tuple[str, str]:
    """How an argument or option is written, and what it means."""
    names = [parameter.metavar]
    if is_option(parameter):
        kind = parameter.metavar or parameter.display_type(context).strip("<>").removesuffix(" range")
        value = "" if parameter.is_flag else f" {kind}"
        names = [f"{name}{value}" for name in (*parameter.opts, *parameter.secondary_opts)]
    default = f" Default: {parameter.show_default}." if isinstance(parameter.show_default, str) else ""
    meaning = as_markdown(parameter.help).replace("\n\n", " ") + default
    return ", ".join(f"`{name}`" for name in names).replace("|", "\\|"), meaning.replace("|", "\\|")


def as_markdown(text: str) -> str:
    """The paragraphs of a help text, each on a line, with what would be markup outside of code escaped."""
    paragraphs = (" ".join(one.split()) for one in re.split(r"\n\s*\n", text.replace("\b", "").strip()))
    pieces = re.split(r"(`[^`]*`)", "\n\n".join(paragraphs))
    return "".join(
        piece if piece.startswith("`") else piece.replace("<", "&lt;").replace("*", r"\*") for piece in pieces
    )


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
