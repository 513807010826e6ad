"""JSON files as plain data, with errors in one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tracking3d.errors import InputError


def read_json(file: Path) -> dict[str, Any]:
    """Read a JSON file whose top level is an object.

    Raises:
        InputError: If the file is missing, cannot be read or holds anything else.
    """
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(f"There is no file {file}; restore it.") from error
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{file} cannot be read as JSON ({error}); restore it.") from error
    if not isinstance(document, dict):
        raise InputError(f"{file} is not a JSON object; restore it.")
    return document
