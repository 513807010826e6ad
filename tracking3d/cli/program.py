"""How every command ends: one sentence instead of a traceback, and an exit code.

0 success, 1 a bug in the program, 2 bad input or too little memory or disk space, 130 interrupted by Ctrl-C or SIGTERM,
141 the output is piped into a program that has ended.
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
from pathlib import Path
from types import FrameType
from typing import Any

import typer
from typer.core import TyperGroup, TyperOption

from tracking3d.cli.plugged_commands import fault_of, plugged_command, registered_commands
from tracking3d.errors import InputError, Tracking3dError

INTERRUPTED = 130
UNREAD = 141
"""Exit code of a program whose output is piped into one that has ended, such as ``head``."""


def _show_flags_without_type() -> None:
    """Keep ``--help`` from printing ``<bool>`` behind each flag, as newer versions of typer do."""
    shown = getattr(TyperOption, "display_type_rich", None)
    if shown is not None:
        TyperOption.display_type_rich = (  # type: ignore[method-assign]
            lambda self, ctx: None if self.is_flag else shown(self, ctx)
        )


_show_flags_without_type()


class Program(TyperGroup):
    """The root command; ``--debug`` anywhere shows the traceback too."""

    def main(self, args: Sequence[str] | None = None, *more: Any, **extra: Any) -> Any:
        """Run a command line (``sys.argv`` if None) and exit with its code."""
        arguments = sys.argv[1:] if args is None else list(args)
        _print_anything()
        try:
            _refuse_empty(arguments)
            _refuse_deleted_folder()
            code = super().main(arguments, *more, **{**extra, "standalone_mode": False})
            if sys.stdout is not None:  # None if it was closed before the program started
                sys.stdout.flush()
        except Exception as error:
            if "--debug" in arguments:
                traceback.print_exc()
            code = _report(error)
        except SystemExit as error:  # how click and rich exit if nobody reads what they print
            code = UNREAD if _is_unread(error.__context__) else error.code
        if code == UNREAD:
            _print_nowhere()
        # On success --help and --version return 0, and the other commands None.
        sys.exit(code if isinstance(code, int) else 0)

    def list_commands(self, ctx: Any) -> list[str]:
        """This package's commands, and those of others that can be loaded."""
        own = super().list_commands(ctx)
        others = (name for name, point in registered_commands().items() if not fault_of(point))
        return [*own, *sorted(set(others).difference(own))]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """A command of this package, or else of another."""
        return super().get_command(ctx, cmd_name) or plugged_command(cmd_name)

    def invoke(self, ctx: Any) -> Any:
        """Call the command; Ctrl-C or SIGTERM ends it, and its notes are printed."""
        try:
            with _end_as_by_ctrl_c():
                return super().invoke(ctx)
        except KeyboardInterrupt as error:
            _print("interrupted", error)
            raise typer.Exit(INTERRUPTED) from error


class WithDefault(TyperGroup):
    """A group whose command ``default`` need not be named."""

    default: str

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Insert the default command if the first word names none."""
        return list(super().parse_args(ctx, self.with_command(args)))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command that the first word names, or the default one."""
        return super().resolve_command(ctx, self.with_command(args))

    def with_command(self, args: list[str]) -> list[str]:
        """The arguments behind the name of a command."""
        return [self.default, *args] if args and args[0] not in (*self.commands, "--help") else args


_AT_ONCE = 5.0
"""Seconds after the first SIGTERM in which further ones are ignored."""


@contextmanager
def _end_as_by_ctrl_c() -> Iterator[None]:
    """Let SIGTERM, which containers and batch systems send, end the command as Ctrl-C does.

    Some systems send a second one at once; it does not interrupt the writing of results. A later one does, because an
    imported library may have caught the first.
    """
    first: list[float] = []

    def stop(number: int, frame: FrameType | None) -> None:
        first.append(time.monotonic())
        if len(first) == 1 or first[-1] - first[0] > _AT_ONCE:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield  # signals can be handled in the main thread only
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def _report(error: Exception) -> int:
    """Print the error as one sentence, and return the exit code."""
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
    elif isinstance(error, OSError) and error.errno == errno.ENAMETOOLONG:
        name = os.fsdecode(error.filename or "A name")
        sentence, code = (
            f"{name[:60]}... is too long for the name of a file or folder; choose a shorter one.",
            2,
        )
    else:
        what = f"{type(error).__name__}: {_text(error)}"
        sentence, code = f"this is a bug in tracking3d ({what}); add --debug to see where.", 1
    if sentence:
        _print(f"error: {' '.join(sentence.split())}", error)
    return code


def _too_little(error: BaseException) -> str:
    """Which resource of the machine has run out, in a sentence; empty if none has."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        _print_nowhere()
        return f"the output cannot be written ({error.strerror}); free some disk space, or redirect it elsewhere."
    if isinstance(error, MemoryError) or _NO_MEMORY.search(_text(error)):
        return (
            "there is not enough memory; lower --size (window.size), object.texture_size or solver.max_keyframes, "
            "track fewer objects at once, or close other programs."
        )
    return ""


_NO_MEMORY = re.compile(
    "can't allocate memory|cannot allocate memory|failed to allocate|out of memory|insufficient memory|"
    "bad_alloc|can't start new thread|failed to map segment",
    re.IGNORECASE,
)
"""How torch, OpenCV, LLVM and the system report missing memory; not all of them raise a `MemoryError`."""


def _text(error: BaseException) -> str:
    """What an exception says; it may come from code that cannot even say that."""
    try:
        return str(error)
    except Exception:
        return "it cannot be printed"


def _is_unread(error: BaseException | None) -> bool:
    return isinstance(error, BrokenPipeError)


def _print_anything() -> None:
    """A letter that the terminal cannot show is printed as its number, and does not end the program."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _print_nowhere() -> None:
    """Discard all further output, also what Python flushes at its end."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def _refuse_empty(arguments: Sequence[str]) -> None:
    """Refuse empty values: most likely a script uses a variable that is not set.

    Raises:
        InputError: An option or an argument is empty.
    """
    for option, value in zip(["", *arguments], arguments, strict=False):
        if value == "" or re.fullmatch("--[a-z-]+=", value):
            name = value.rstrip("=") or (option if option.startswith("-") else "an argument")
            raise InputError(f"{name} is empty; give it a value or leave it out.")


def _refuse_deleted_folder() -> None:
    """Refuse to run where there is no folder any more; libraries of torch end the process there.

    Raises:
        InputError: The current folder was deleted.
    """
    try:
        Path.cwd()
    except FileNotFoundError as error:
        raise InputError("The current folder has been deleted; change to one that exists.") from error


def _print(line: str, error: BaseException) -> None:
    with suppress(OSError):  # if nothing can be printed, the exit code says enough
        for text in (line, *getattr(error, "__notes__", ())):
            typer.echo(text, err=True)


def _usage(error: Any) -> str:
    context = getattr(error, "ctx", None)
    sentence = error.format_message().rstrip(".")
    if not sentence:  # a group without a command has already printed its help
        return ""
    return f"{sentence}; see `{context.command_path} --help`." if context else f"{sentence}."
