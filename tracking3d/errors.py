"""The errors a user can cause, each one sentence: what is wrong, where, and what to do."""

from __future__ import annotations


class Tracking3dError(Exception):
    """Base of all errors that the command line prints as one sentence instead of a traceback."""


class InputError(Tracking3dError):
    """Something the user gave cannot be used: a file, a box, a mask, an option. Exit code 2."""


class PluginError(Tracking3dError):
    """A plug-in is unknown, cannot be loaded, or failed while running. Exit code 2."""


class OutputError(Tracking3dError):
    """A result cannot be written: folder in use, not writable, disk full. Exit code 2."""
