"""The settings of a run as flat names and values."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tracking3d.config.loading import load_config


@dataclass(frozen=True)
class Setting:
    """One setting."""

    name: str  # with its section, such as solver.local_window
    value: str  # as text
    # the value of preset default, if that is another one; None if it is the same or unknown
    usual: str | None


def settings_of(config: Mapping[str, Any]) -> list[Setting]:
    """Every setting of a run, next to its default.

    Args:
        config: The configuration as ``run.json`` holds it.
    """
    usual = flat(load_config().model_dump(mode="json"))
    return [
        Setting(name, value, usual[name] if usual.get(name, value) != value else None)
        for name, value in flat(config).items()
    ]


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Names with their sections, and values as text."""
    found: dict[str, str] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            found |= flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value if isinstance(value, str) else json.dumps(value)
    return found
