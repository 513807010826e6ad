"""One configuration from its layers: model defaults, preset, quality, file, ``--set``, and options given directly.

A later layer overrides an earlier one key by key. If a layer names another solver or plug-in, the settings that lower
layers gave to the old one are dropped; settings without a name belong to whichever solver or plug-in is chosen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tracking3d.config.choices import QUALITIES, check_quality
from tracking3d.config.explain import describe_validation_error, format_value, hint
from tracking3d.config.models import AUTO, PipelineConfig, PluginChoice
from tracking3d.config.prompt_section import PromptSection
from tracking3d.config.yaml_files import parse_yaml, read_mapping
from tracking3d.errors import InputError, argument

_MOST_LEAVES = 12  # settings of a layer that are listed one by one

DEFAULT_PRESET = "default"
"""The preset that is used if none is named."""

_CHOICES = [
    "solver",
    *(name for name, field in PipelineConfig.model_fields.items() if field.annotation is PluginChoice),
]
"""Sections whose ``name`` decides what their other keys belong to."""

Layer = tuple[str, Mapping[str, Any]]
"""Origin of settings, as messages name it, and the settings."""


def load_config(
    file: Path | None = None,
    preset: str | None = None,
    overrides: Sequence[str] = (),
    *,
    quality: str | None = None,
    **direct: Any,
) -> PipelineConfig:
    """Build the configuration of a run.

    Args:
        file: A YAML file, or the name of a ready one (`ready_files`); it may choose its preset by a top-level
            ``preset: name`` and its quality by ``quality: name``.
        preset: Name of a preset; overrides the file's.
        quality: ``draft``, ``good`` or ``best``: tracker, resolution, refinement and final mesh together; overrides
            the preset, and the file's own quality.
        overrides: ``section.key=value`` items as ``--set`` takes them; the value is YAML.
        direct: Settings by section, such as ``camera={"fov": 60}`` or ``tracker="csrt"``; they override all others.

    Returns:
        The validated configuration. The options of plug-ins are not checked here; see
        `tracking3d.plugins.check_options`.

    Raises:
        InputError: A file, preset, key or value cannot be used.
    """
    settings: dict[str, Any] = PipelineConfig().model_dump()
    layers = _files(file, preset, quality)
    spoken = [(_name_of(item), _parse_override(item)) for item in overrides]
    spoken.append(("", direct))
    # The names chosen on the command line come first, so that with `--tracker precomputed` the option of
    # `--set tracker.path=...` belongs to that tracker.
    chosen = [(origin, _chosen_names(layer)) for origin, layer in spoken]

    for origin, layer in [*layers, *chosen, *spoken]:
        settings = _merge(settings, _without_shorthand(layer), _CHOICES)
        config = _validate(settings, origin)
    return config


def load_prompt(file: Path | None) -> PromptSection:
    """The prompt in a configuration file; empty if there is no file.

    Raises:
        InputError: The file or that section cannot be used.
    """
    return _prompt_of(file, read_mapping(_locate(Path(file)), empty={}) if file is not None else {})


def layers_in_words(
    file: Path | None = None, preset: str | None = None, quality: str | None = None
) -> list[str]:
    """The layers below the command line, lowest first: the origin of each, and what it sets.

    Raises:
        InputError: As `load_config`.
    """
    words = []
    for origin, layer in _files(file, preset, quality):
        leaves = _leaves(_without_shorthand(layer))
        more = f" and {len(leaves) - _MOST_LEAVES} more" if len(leaves) > _MOST_LEAVES else ""
        words.append(f"{origin}: {', '.join(leaves[:_MOST_LEAVES]) or 'changes nothing'}{more}")
    return words


def list_presets() -> list[str]:
    """The names of the presets that come with the package."""
    files = (resources.files("tracking3d.config") / "presets").iterdir()
    return sorted(Path(item.name).stem for item in files if item.name.endswith(".yaml"))


def list_qualities() -> list[str]:
    """The names of the qualities, fastest first."""
    return list(QUALITIES)


def ready_files() -> dict[str, Path]:
    """The configuration files that come with the package, those of ``configs/``, by name."""
    folder = Path(str(resources.files("tracking3d.config"))) / "ready_files"
    return {file.stem: file for file in sorted(folder.glob("*.yaml"))}


def config_schema() -> dict[str, Any]:
    """The JSON schema of a configuration file, for editors and other tools."""
    schema = PipelineConfig.model_json_schema()
    schema["properties"]["preset"] = {
        "type": "string",
        "enum": list_presets(),
        "default": DEFAULT_PRESET,
        "description": "Preset that the settings of this file override.",
    }
    schema["properties"]["quality"] = {
        "type": "string",
        "enum": list_qualities(),
        "description": "Tracker, resolution, refinement and final mesh together, which this file's settings override.",
    }
    prompt = PromptSection.model_json_schema()
    schema["properties"]["prompt"] = {
        **prompt,
        "description": "The objects to track; read by `tracking3d run` only.",
    }
    choice = schema["$defs"]["PluginChoice"]
    schema["$defs"]["PluginChoice"] = {"anyOf": [{"type": "string"}, choice]}
    solver = schema["properties"]["solver"]
    solvers = solver.pop("oneOf")
    names = list(solver.pop("discriminator")["mapping"])
    solver["anyOf"] = [{"type": "string", "enum": names}, *solvers]
    return schema


def _locate(file: Path) -> Path:
    """The file itself; if it does not exist, the ready one of that name, with or without ``configs/``.

    Raises:
        InputError: Neither exists.
    """
    try:
        there = file.exists()
    except OSError:  # an impossible file name; opening it says why
        there = True
    if there:
        return file
    ready = ready_files()
    if file.parent in (Path(), Path("configs")) and file.suffix in ("", ".yaml") and file.stem in ready:
        return ready[file.stem]
    raise InputError(
        f"The configuration file {file} does not exist (ready ones: {', '.join(ready)}); {hint(file.stem, ready)}"
    )


def _files(file: Path | None, preset: str | None, quality: str | None) -> list[Layer]:
    """The layers that come from files: preset, quality and configuration file."""
    from_file = read_mapping(_locate(Path(file)), empty={}) if file is not None else {}
    _prompt_of(file, from_file)
    named = {}
    for key, spoken in (("preset", preset), ("quality", quality)):
        name = from_file.pop(key, {})
        if not isinstance(name, str) and name != {}:
            raise InputError(f"{file}: '{key}' must be the name of a {key}, not {format_value(name)}.")
        named[key] = spoken if spoken is not None else None if name == {} else name
    chosen = DEFAULT_PRESET if named["preset"] is None else named["preset"]
    layers = [_named_layer("preset", "presets", list_presets(), chosen)]
    if named["quality"] is not None:
        check_quality(named["quality"], None if quality is not None else file)
        layers.append(_named_layer("quality", "qualities", list_qualities(), named["quality"]))
    return [*layers, (str(file), from_file)] if file is not None else layers


def _prompt_of(file: Path | None, from_file: dict[str, Any]) -> PromptSection:
    """The section ``prompt``, removed from the content of a file."""
    given = from_file.pop("prompt", {})
    if not isinstance(given, dict):
        raise InputError(
            f"{file}: 'prompt' must be a mapping, such as 'prompt: {{box: \"301,11,296,227\"}}'."
        )
    try:
        return PromptSection.model_validate(given)
    except ValidationError as error:
        raise InputError(f"{file}: prompt.{describe_validation_error(error, PromptSection)}") from error


def _named_layer(kind: str, folder: str, names: Sequence[str], name: str) -> Layer:
    if name not in names:
        raise InputError(f"There is no {kind} '{name}'; {hint(name, names)}")
    with resources.as_file(resources.files("tracking3d.config") / folder / f"{name}.yaml") as path:
        return f"{kind} {name}", read_mapping(path)


def _leaves(settings: Mapping[str, Any], prefix: str = "") -> list[str]:
    """``section.key=value`` of all settings of a layer."""
    leaves = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            leaves += _leaves(value, f"{prefix}{key}.")
        else:
            leaves.append(f"{prefix}{key}={value}")
    return leaves


def _name_of(override: str) -> str:
    """Name of an override in messages."""
    return argument(f"overrides: {override}", f"--set {override}")


def _parse_override(item: str) -> dict[str, Any]:
    """Turn ``a.b.c=value`` into ``{"a": {"b": {"c": value}}}``."""
    path, equals, text = item.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not equals or not all(keys):
        raise InputError(f"{_name_of(item)} is not section.key=value; write it like runtime.seed=1.")
    value: Any = parse_yaml(text, _name_of(item))
    for key in reversed(keys[1:]):
        value = {key: value}
    return {keys[0]: value}


def _without_shorthand(layer: Mapping[str, Any]) -> dict[str, Any]:
    """Write ``tracker: csrt`` as ``tracker: {name: csrt}``."""
    return {
        key: {"name": value} if key in _CHOICES and isinstance(value, str) else value
        for key, value in layer.items()
    }


def _chosen_names(layer: Mapping[str, Any]) -> dict[str, Any]:
    """The names that a layer chooses, without their settings."""
    return {
        section: {"name": value["name"]}
        for section, value in _without_shorthand(layer).items()
        if section in _CHOICES and isinstance(value, dict) and isinstance(value.get("name"), str)
    }


def _merge(lower: Mapping[str, Any], upper: Mapping[str, Any], choices: Sequence[str] = ()) -> dict[str, Any]:
    """``lower`` with the values of ``upper``, mapping by mapping.

    The sections in ``choices`` have a name: if it changes, nothing of ``lower`` is kept, unless the name was ``auto``.
    They are at the top level, where validation refuses null; further down, a section with all lines commented out
    changes nothing.
    """
    result = dict(lower)
    for key, value in upper.items():
        below = result.get(key)
        if isinstance(below, dict) and value is None and not choices:
            continue
        if isinstance(below, dict) and isinstance(value, dict):
            if key in choices and below["name"] not in (AUTO, value.get("name", below["name"])):
                below = {}
            value = _merge(below, value)
        result[key] = value
    return result


def _validate(settings: Mapping[str, Any], origin: str) -> PipelineConfig:
    try:
        return PipelineConfig.model_validate(settings)
    except ValidationError as error:
        prefix = f"{origin}: " if origin else ""
        raise InputError(prefix + describe_validation_error(error, PipelineConfig)) from error
