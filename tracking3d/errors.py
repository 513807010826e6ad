"""The errors a user can cause, each one sentence: what is wrong, where, and what to do."""

from __future__ import annotations

import re

_NAMED = re.compile("\x02([^\x1f]*)\x1f([^\x03]*)\x03")


def argument(name: str, option: str) -> str:
    """What the sentence of an error calls an argument; to be put into that sentence.

    Args:
        name: For who calls the library, such as ``box=``.
        option: For who calls the command line, such as ``--box``.
    """
    return f"\x02{name}\x1f{option}\x03"


class Tracking3dError(Exception):
    """Base of all errors that the command line prints as one sentence instead of a traceback.

    Args:
        sentence: May name arguments by `argument`; as a text, the error names them as the library does.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(_NAMED.sub(r"\1", sentence))
        self._sentence = sentence

    @property
    def at_the_command_line(self) -> str:
        """The sentence with options in place of the library's arguments."""
        return _NAMED.sub(r"\2", self._sentence)


class InputError(Tracking3dError):
    """Something the user gave cannot be used: a file, a box, a mask, an option. Exit code 2."""


class PluginError(Tracking3dError):
    """A plug-in is unknown, cannot be loaded, or failed while running. Exit code 2."""


class OutputError(Tracking3dError):
    """A result cannot be written: folder in use, not writable, disk full. Exit code 2."""
