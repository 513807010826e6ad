"""Options for the configuration, and the configuration that they make."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tracking3d.cli.options.general import SETTINGS, Model, Quality

if TYPE_CHECKING:
    from tracking3d.config.models import PipelineConfig

ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE.yaml",
        help="Configuration file, or the name of one that `config list` prints.",
        rich_help_panel=SETTINGS,
    ),
]
Preset = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="Named settings to start from: default, rerendering or paper.",
        rich_help_panel=SETTINGS,
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        help="Change a single setting; may be repeated.",
        rich_help_panel=SETTINGS,
    ),
]


@dataclass(frozen=True)
class SettingsOptions:
    """Where the settings come from: file, preset and quality, and what overrides them."""

    config: ConfigFile = None
    preset: Preset = None
    quality: Quality = None
    model: Model = None
    overrides: Overrides = None

    def configure(self, **direct: Any) -> PipelineConfig:
        """The configuration; see `configure`."""
        return configure(self.config, self.preset, self.overrides, self.quality, self.model, **direct)


def configure(
    file: Path | None,
    preset: str | None,
    overrides: list[str] | None,
    quality: str | None = None,
    model: str | None = None,
    **direct: Any,
) -> PipelineConfig:
    """Load the configuration, and check the options of its plug-ins too.

    Args:
        file: Configuration file.
        preset: Name of a preset.
        overrides: ``SECTION.KEY=VALUE`` items.
        quality: Name of a quality.
        model: The final mesh, see `tracking3d.config.loading`.
        **direct: Sections of settings that other options give; those that are None change nothing.

    Raises:
        InputError: A setting is unknown or invalid.
    """
    from tracking3d.config.loading import check_model, load_config, set_model
    from tracking3d.config.models import AUTO
    from tracking3d.pipeline.tracker_selection import check_tracker_options
    from tracking3d.plugins import FEATURES, KEYPOINTS, TRACKERS, check_options, plugin_label

    config = load_config(file, preset, overrides or (), quality=quality, **_without_none(direct))
    if model is not None:
        config = set_model(config, check_model(model))
    # First by name alone: the options of plug-ins are checked by the plug-ins, which take seconds to import.
    if config.tracker.name != AUTO:
        plugin_label(TRACKERS, config.tracker.name)
    plugin_label(FEATURES, config.features.name)
    check_tracker_options(config)
    check_options(FEATURES, config.features)
    check_options(KEYPOINTS, config.keypoints)
    return config


def _without_none(values: dict[str, Any]) -> dict[str, Any]:
    """``values`` without those that are None, section by section."""
    sections = {
        key: _without_none(value) if isinstance(value, dict) else value for key, value in values.items()
    }
    return {key: value for key, value in sections.items() if value is not None and value != {}}
