"""Text files of other tools, with errors in one sentence."""

from __future__ import annotations

from pathlib import Path

from tracking3d.errors import InputError


def read_text(file: Path) -> str:
    """The text of a file in UTF-8.

    Raises:
        InputError: If it is missing or no text.
    """
    try:
        return file.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"There is no file {file}; check the path.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{file} cannot be read as text ({error}); restore it.") from error
