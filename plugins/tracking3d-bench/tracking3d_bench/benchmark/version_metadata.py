"""Metadata of a checkout of any version, so that its own entry points are found and not those of what is installed."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

DISTRIBUTIONS = (".", "plugins/tracking3d-bench")
"""Folders of a checkout that hold a distribution each; earlier versions have the first alone."""


def write_metadata(checkout: Path, folder: Path) -> str:
    """Write into ``folder`` what an installation of each distribution would tell of itself.

    Returns:
        The ``PYTHONPATH`` under which Python takes the checkout for what is installed.
    """
    places = [folder]
    for place in DISTRIBUTIONS:
        file = checkout / place / "pyproject.toml"
        if not file.is_file():
            continue
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        name, version = project["name"], project["version"]
        info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
        info.mkdir(parents=True, exist_ok=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        groups = {"console_scripts": project.get("scripts", {}), **project.get("entry-points", {})}
        lines = [
            line
            for group, points in groups.items()
            for line in (f"[{group}]", *(f"{point} = {value}" for point, value in points.items()))
        ]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        places.append((checkout / place).resolve())
    return os.pathsep.join(map(str, places))
