"""How every command ends: one sentence instead of a traceback, and an exit code.

0 done, 1 a fault of the program itself, 2 something the user gave cannot be used, 130 interrupted.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from tracking3d.errors import Tracking3dError

INTERRUPTED = 130


class Program(TyperGroup):
    """The root command; ``--debug`` anywhere shows the traceback beside the sentence."""

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> Any:
        """Run a command line (``sys.argv`` if None) and leave with its exit code."""
        arguments = sys.argv[1:] if args is None else list(args)
        try:
            code = super().main(arguments, *more, **{**extra, "standalone_mode": False})
        except Exception as error:
            if "--debug" in arguments:
                traceback.print_exc()
            code = _report(error)
        # Of what ended well, --help and --version give 0 and the other commands nothing.
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        """Call the command; Ctrl-C ends it with what it has to say about that."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            _print("interrupted", error)
            raise typer.Exit(INTERRUPTED) from error


def _report(error: Exception) -> int:
    """Print the error as a sentence and return the exit code."""
    if isinstance(error, typer.Abort):
        return INTERRUPTED
    if isinstance(error, Tracking3dError):
        sentence, code = str(error), 2
    elif hasattr(error, "format_message"):  # the command line itself is wrong
        sentence, code = _usage(error), 2
    else:
        what = f"{type(error).__name__}: {error}"
        sentence, code = f"this is a fault of tracking3d ({what}); run it with --debug to see where.", 1
    if sentence:
        _print(f"error: {' '.join(sentence.split())}", error)
    return code


def _print(line: str, error: BaseException) -> None:
    for text in (line, *getattr(error, "__notes__", ())):
        typer.echo(text, err=True)


def _usage(error: Any) -> str:
    context = getattr(error, "ctx", None)
    sentence = error.format_message().rstrip(".")
    if not sentence:  # a group without a command has printed its help
        return ""
    return f"{sentence}; see `{context.command_path} --help`." if context else f"{sentence}."
