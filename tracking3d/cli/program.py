"""How every command ends: one sentence instead of a traceback, and an exit code.

0 done, 1 a fault of the program itself, 2 something the user gave cannot be used or the machine has too little of,
130 interrupted, by Ctrl-C or SIGTERM, 141 nobody reads what is printed.
"""

from __future__ import annotations

import errno
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

import typer
from typer.core import TyperGroup

from tracking3d.errors import InputError, Tracking3dError

INTERRUPTED = 130
UNREAD = 141
"""What a shell calls the end of a program whose output is piped into one that has ended, such as ``head``."""


class Program(TyperGroup):
    """The root command; ``--debug`` anywhere shows the traceback beside the sentence."""

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> Any:
        """Run a command line (``sys.argv`` if None) and leave with its exit code."""
        arguments = sys.argv[1:] if args is None else list(args)
        _print_anything()
        try:
            _refuse_empty(arguments)
            code = super().main(arguments, *more, **{**extra, "standalone_mode": False})
            if sys.stdout is not None:  # as it is where it was closed before the program began
                sys.stdout.flush()
        except Exception as error:
            if "--debug" in arguments:
                traceback.print_exc()
            code = _report(error)
        except SystemExit as error:  # click and rich leave so where nobody reads what they print
            code = UNREAD if _is_unread(error.__context__) else error.code
        if code == UNREAD:
            _print_nowhere()
        # Of what ended well, --help and --version give 0 and the other commands nothing.
        sys.exit(code if isinstance(code, int) else 0)

    def invoke(self, ctx: Any) -> Any:
        """Call the command; Ctrl-C or SIGTERM ends it with what it has to say about that."""
        try:
            with _end_as_by_ctrl_c():
                return super().invoke(ctx)
        except KeyboardInterrupt as error:
            _print("interrupted", error)
            raise typer.Exit(INTERRUPTED) from error


_AT_ONCE = 5.0
"""Seconds after a first SIGTERM in which others mean the same."""


@contextmanager
def _end_as_by_ctrl_c() -> Iterator[None]:
    """Let SIGTERM, which containers and batch systems stop with, end the command as Ctrl-C does.

    A second one, which some send at once, does not end what is written at the end. One that comes later does: a library
    that is imported may have caught the first.
    """
    first: list[float] = []

    def stop(number: int, frame: FrameType | None) -> None:
        first.append(time.monotonic())
        if len(first) == 1 or first[-1] - first[0] > _AT_ONCE:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield  # where no signal can be handled
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def _report(error: Exception) -> int:
    """Print the error as a sentence and return the exit code."""
    if isinstance(error, typer.Abort):
        return INTERRUPTED
    if _is_unread(error):
        return UNREAD
    if isinstance(error, Tracking3dError):
        sentence, code = error.at_the_command_line, 2
    elif hasattr(error, "format_message"):  # the command line itself is wrong
        sentence, code = _usage(error), 2
    elif too_little := _too_little(error):
        sentence, code = too_little, 2
    else:
        what = f"{type(error).__name__}: {error}"
        sentence, code = f"this is a fault of tracking3d ({what}); run it with --debug to see where.", 1
    if sentence:
        _print(f"error: {' '.join(sentence.split())}", error)
    return code


def _too_little(error: BaseException) -> str:
    """What the machine has too little of, in a sentence; empty where that is not the reason."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        _print_nowhere()
        return (
            f"what is printed cannot be written ({error.strerror}); free some space, or print somewhere else."
        )
    if isinstance(error, MemoryError) or _NO_MEMORY.search(str(error)):
        return (
            "there is not enough memory; lower --size (window.size), object.texture_size or solver.max_keyframes, "
            "track fewer objects at once, or end other programs."
        )
    return ""


_NO_MEMORY = re.compile(
    "can't allocate memory|cannot allocate memory|failed to allocate|out of memory|insufficient memory|"
    "bad_alloc|can't start new thread|failed to map segment",
    re.IGNORECASE,
)
"""How torch, OpenCV, LLVM and the system say that memory has ended; not all of them raise a `MemoryError`."""


def _is_unread(error: BaseException | None) -> bool:
    return isinstance(error, BrokenPipeError)


def _print_anything() -> None:
    """A terminal that has no sign for a letter shows its number instead of ending the program."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _print_nowhere() -> None:
    """What is still to be printed, when Python ends too, is lost in silence."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _refuse_empty(arguments: Sequence[str]) -> None:
    """An option with nothing behind it is an unset variable of a script more likely than a choice.

    Raises:
        InputError: If there is one, or an empty argument.
    """
    for option, value in zip(["", *arguments], arguments, strict=False):
        if value == "" or re.fullmatch("--[a-z-]+=", value):
            name = value.rstrip("=") or (option if option.startswith("-") else "an argument")
            raise InputError(f"{name} is empty; give it a value or leave it out.")


def _print(line: str, error: BaseException) -> None:
    with suppress(OSError):  # where nothing can be printed the exit code has to do
        for text in (line, *getattr(error, "__notes__", ())):
            typer.echo(text, err=True)


def _usage(error: Any) -> str:
    context = getattr(error, "ctx", None)
    sentence = error.format_message().rstrip(".")
    if not sentence:  # a group without a command has printed its help
        return ""
    return f"{sentence}; see `{context.command_path} --help`." if context else f"{sentence}."
