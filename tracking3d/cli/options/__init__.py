"""Options of the commands by subject, and the groups that commands take."""

from __future__ import annotations

from tracking3d.cli.options.general import AsJson, Debug, Quiet, Run, RunOrParent, Video, grouped, numbers
from tracking3d.cli.options.settings import ConfigFile, Overrides, Preset, Quality, SettingsOptions, configure

__all__ = [
    "AsJson",
    "ConfigFile",
    "Debug",
    "Overrides",
    "Preset",
    "Quality",
    "Quiet",
    "Run",
    "RunOrParent",
    "SettingsOptions",
    "Video",
    "configure",
    "grouped",
    "numbers",
]
