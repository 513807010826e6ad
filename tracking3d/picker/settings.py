"""The settings that the picker's page offers: the words of the command line, and what they come to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tracking3d.config.loading import MODELS, QUALITIES
from tracking3d.config.models import AUTO, PipelineConfig
from tracking3d.errors import InputError
from tracking3d.plugins import FEATURES, TRACKERS, list_plugins

TRACKER_FOR = {
    "segment": "an object in a hand, a vehicle, most real videos; the default where no network was downloaded",
    "auto": "the best masks, by networks that `tracking3d models get recommended` downloads (7 MB); the default from "
    "then on",
    "flow": "an object on a turntable, or one that moves by itself, with nothing that moves along",
    "csrt": "an object that looks like its background, if other masks spread over it",
    "precomputed": "masks of all frames that another program has made (`--masks`)",
}
"""What each mask tracker is for; the documentation has the same table."""
_NEEDS_FILES = "precomputed"
"""The tracker whose masks lie in a folder, which a page cannot choose."""

Word = Annotated[str, Field(min_length=1, max_length=80)]
Pixels = Annotated[float, Field(allow_inf_nan=False)]


class ChosenSettings(BaseModel):
    """What was chosen; None stands for what is below it: quality, preset and configuration file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    tracker: Word | None = None  # name of the mask tracker, as --tracker takes it
    quality: Word | None = None  # as --quality takes it
    model: Word | None = None  # the final mesh, as --model takes it
    features: Word | None = None  # name of the feature encoder, as --features takes it
    fov: Pixels | None = None  # vertical field of view in degrees, as --fov takes it
    # (fx, fy, cx, cy) in pixels, as --intrinsics takes them
    intrinsics: tuple[Pixels, Pixels, Pixels, Pixels] | None = None


@dataclass(frozen=True)
class SettingsMenu:
    """The settings that can be chosen on the page."""

    chosen: ChosenSettings  # those that are chosen at first
    # makes the configuration of a run from them; raises a `Tracking3dError` if it cannot
    configure: Callable[[ChosenSettings], PipelineConfig]


def setting_choices(config: PipelineConfig) -> dict[str, list[str]]:
    """The words that each setting can have: those of the command line, and installed plug-ins that work.

    Args:
        config: The configuration at first, whose plug-ins are always among them.
    """
    usable = [plugin for plugin in list_plugins() if plugin.status == "ok"]
    trackers = [one.name for one in usable if one.group == TRACKERS and one.name != _NEEDS_FILES]
    features = [one.name for one in usable if one.group == FEATURES]
    return {
        "tracker": list(dict.fromkeys([AUTO, config.tracker.name, *trackers])),
        "quality": list(QUALITIES),
        "model": list(MODELS),
        "features": list(dict.fromkeys([config.features.name, *features])),
    }


def tracker_lines() -> dict[str, str]:
    """What each mask tracker is for; of further ones, where they come from."""
    further = {one.name: f"from {one.package}" for one in list_plugins() if one.group == TRACKERS}
    return further | {"onnx": "networks that you name"} | TRACKER_FOR


def settings_in_words(config: PipelineConfig) -> dict[str, str]:
    """What a configuration comes to, for the settings that were not chosen."""
    shape = config.object
    textured = shape.texture_views and config.solver.final_refine
    return {
        "tracker": config.tracker.name,
        "model": shape.shape if textured or shape.shape == "fine" else "none",
        "features": config.features.name,
    }


def parse_settings(text: bytes) -> ChosenSettings:
    """The settings from JSON.

    Raises:
        InputError: If they are none.
    """
    try:
        return ChosenSettings.model_validate_json(text)
    except ValidationError as error:
        first: Any = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise InputError(f"The settings cannot be used: {where or 'they'}: {first['msg']}.") from error
