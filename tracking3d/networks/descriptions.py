"""Descriptions of networks: short YAML files with the inputs and outputs of a network."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Any

from tracking3d.config.explain import hint
from tracking3d.config.yaml_files import read_mapping
from tracking3d.errors import InputError


def description_names(package: str) -> list[str]:
    """Names of the descriptions that come with a package, in its folder ``descriptions``."""
    folder = resources.files(package) / "descriptions"
    return sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(".yaml"))


def read_description(name: str | Path, package: str, noun: str) -> tuple[Path, dict[str, Any]]:
    """Read a description that comes with a package, or a user's own.

    Args:
        name: Name of one of the package's, or a YAML file.
        package: The package, such as ``tracking3d.features.onnx``.
        noun: What is described, as messages call it.

    Returns:
        The file and its keys, not checked yet.

    Raises:
        InputError: If there is no such description, or it is no YAML mapping.
    """
    names = description_names(package)
    if str(name) in names:
        with resources.as_file(resources.files(package) / "descriptions" / f"{name}.yaml") as file:
            return file, dict(read_mapping(file))
    file = Path(name).expanduser()
    if not file.is_file():
        raise InputError(
            f"There is no {noun} '{name}'; give a YAML file or one of {', '.join(names)}: "
            f"{hint(str(name), names)}"
        )
    return file, dict(read_mapping(file))
