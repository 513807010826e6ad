"""Which file a network is: a path, or the name of a known one in the user's cache."""

from __future__ import annotations

from pathlib import Path

from tracking3d.errors import InputError


def find_network(name: str | Path) -> Path:
    """The ONNX file that ``name`` means.

    Args:
        name: The path of a file, or the name of a known network, see ``tracking3d models list``.

    Raises:
        InputError: If there is no such file.
    """
    file = Path(name).expanduser()
    if not file.is_file():
        raise InputError(f"The network {name} does not exist; give the path of an ONNX file.")
    return file
