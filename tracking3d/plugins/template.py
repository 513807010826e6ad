"""A new plug-in as a package ready to install, from the templates next to this module."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path
from string import Template
from typing import Literal

from tracking3d.errors import InputError, OutputError
from tracking3d.plugins.registration import FEATURES, KEYPOINTS, KIND, TRACKERS, find_plugins

Kind = Literal["tracker", "features", "keypoints"]
_GROUPS: dict[str, str] = {"tracker": TRACKERS, "features": FEATURES, "keypoints": KEYPOINTS}
_SUFFIXES = {"tracker": "Tracker", "features": "Encoder", "keypoints": "Detector"}


def write_plugin(name: str, kind: Kind, folder: Path) -> Path:
    """Write a package with one plug-in: pyproject, module, test, README.

    Args:
        name: Name of the plug-in: lower-case letters, digits and single hyphens, a letter first.
        kind: Kind of plug-in.
        folder: Folder in which the package's folder ``tracking3d-<name>`` is created; created itself if needed.

    Returns:
        The package's folder.

    Raises:
        InputError: The name cannot be used or is taken, or the package's folder exists.
        OutputError: The package cannot be written.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name) or len(name) > 40:
        raise InputError(
            f"'{name}' cannot be the name of a plug-in; use lower-case letters and digits, a letter first, and hyphens "
            "between words, such as my-tracker."
        )
    group = _GROUPS[kind]
    for plugin in find_plugins():
        if (plugin.group, plugin.name) == (group, name):
            raise InputError(f"The name is taken by the {plugin.label}; choose another.")
    package = f"tracking3d-{name}"
    target = folder.expanduser() / package
    if target.exists():
        raise InputError(f"{target} already exists; choose another name or another --out.")
    module = package.replace("-", "_")
    words = {
        "name": name,
        "package": package,
        "module": module,
        "class_name": "".join(word.capitalize() for word in name.split("-")) + _SUFFIXES[kind],
        "group": group,
        "kind": KIND[group],
        "option": f"set {kind}={name}" if kind == "keypoints" else f"{kind} {name}",
    }
    files = {
        "pyproject.toml": "pyproject.toml.txt",
        "README.md": "README.md.txt",
        f"{module}/__init__.py": f"{kind}/module.txt",
        f"tests/test_{module.removeprefix('tracking3d_')}.py": f"{kind}/test.txt",
    }
    templates = resources.files(__package__) / "templates"
    try:
        for path, template in files.items():
            text = (templates / template).read_text(encoding="utf-8")
            file = target / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(Template(text).substitute(words), encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{target} cannot be written: {error.strerror or error}; choose another --out."
        ) from error
    return target
