"""One configuration from its layers: model defaults, preset, quality, file, ``--set``, and options given directly.

A later layer overrides an earlier one key by key. If a layer names another solver or plug-in, the settings that lower
layers gave to the old one are dropped; settings without a name belong to whichever solver or plug-in is chosen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Literal, cast, get_args

import yaml
from pydantic import ValidationError

from tracking3d.config.explain import describe_validation_error, format_value, hint
from tracking3d.config.models import AUTO, ObjectConfig, PipelineConfig, PluginChoice, PromptSection
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


Quality = Literal["draft", "good", "best"]
"""Tracker, resolution, refinement and final mesh together, fastest first."""
ModelChoice = Literal["auto", "none", "fast", "fine"]
"""The final mesh: the online map's, with a texture from the video, with a reconstructed shape, or the best of these."""

QUALITIES: tuple[str, ...] = get_args(Quality)
MODELS: tuple[str, ...] = get_args(ModelChoice)

_IN_A_FILE = {
    "auto": "--model, in a file object.shape: auto",
    "none": "--model, in a file object.texture_views: 0",
    "fast": "--model, in a file object.shape: fast",
    "fine": "--model, in a file object.shape: fine",
}


def check_quality(value: Any, file: Path | None = None) -> Quality:
    """``value``, if it is a quality.

    Args:
        value: What was given.
        file: The configuration file that it is from; None for an argument or option.

    Raises:
        InputError: It is not; if it is a final mesh, the sentence says where that is given.
    """
    if isinstance(value, str) and value in MODELS:
        name, other = (
            argument("quality=", "--quality"),
            argument(f"model=: model='{value}'", f"--model: --model {value}"),
        )
        if file is not None:
            name, other = f"{file}: quality", _IN_A_FILE[value]
        raise InputError(f"{name} sets draft, good or best; {value} is a value of {other}.")
    if value not in QUALITIES:
        raise InputError(f"There is no quality {format_value(value)}; {hint(str(value), QUALITIES)}")
    return cast(Quality, value)


def check_model(value: Any) -> ModelChoice:
    """``value``, if it is a final mesh.

    Raises:
        InputError: It is not; if it is a quality, the sentence says where that is given.
    """
    if isinstance(value, str) and value in QUALITIES:
        name = argument("model=", "--model")
        other = argument(f"quality= of load_config: quality='{value}'", f"--quality: --quality {value}")
        raise InputError(f"{name} sets auto, none, fast or fine; {value} is a value of {other}.")
    if not isinstance(value, str) or value not in MODELS:
        name = argument(f"model={format_value(value)}", f"--model {value}")
        raise InputError(f"{name} is unknown; give 'auto', 'none', 'fast' or 'fine'.")
    return cast(ModelChoice, value)


def set_model(config: PipelineConfig, model: ModelChoice | None) -> PipelineConfig:
    """The configuration with another final mesh; the same if ``model`` is None.

    Raises:
        InputError: The object is known, so that its mesh is fixed, or frames are not re-estimated.
    """
    if model is None or (model == "auto" and config.object.model is not None):
        return config
    shape, name = config.object, argument(f"model='{model}'", f"--model {model}")
    if model != "none" and shape.model is not None:
        what = "shape" if model == "fine" else "texture"
        raise InputError(
            f"{name} makes the {what} again, but those of a known object are fixed; leave it out, or leave out "
            f"{argument('object=', '--object')}."
        )
    if model == "fast" and not config.solver.final_refine:
        raise InputError(
            f"{name} takes the texture from the frames as they are re-estimated, which they are not without the final "
            "refinement (solver.final_refine); leave it out."
        )
    default = ObjectConfig.model_fields["texture_views"].default
    some = shape.texture_views or default
    views = {"auto": some, "none": 0, "fast": some, "fine": shape.texture_views}[model]
    changed = {"texture_views": views, "shape": "fast" if model == "none" else model}
    return config.model_copy(update={"object": shape.model_copy(update=changed)})


_LONGEST = 256 << 10
_MOST_VALUES = 100_000
_DEEPEST = 60


class _StrictLoader(yaml.SafeLoader):
    """PyYAML's safe loader (no tag runs code), which also refuses duplicate keys and keys that are not text."""


def _mapping(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[str] = set()
    for key_node, _ in node.value:
        if key_node.tag == "tag:yaml.org,2002:merge":
            continue
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(
                None, None, f"the key {format_value(key)} is not text", key_node.start_mark
            )
        if key in seen:
            raise yaml.constructor.ConstructorError(
                None, None, f"the key '{key}' is given twice", key_node.start_mark
            )
        seen.add(key)
    # deep, so that a mapping that contains itself is found here and not followed for ever elsewhere
    return loader.construct_mapping(node, deep=True)


_StrictLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def parse_yaml(text: str, origin: str) -> Any:
    """Parse one YAML document.

    Args:
        text: The document.
        origin: Its name in messages, such as the file name.

    Raises:
        InputError: Not YAML, a tag that is not plain data, a key given twice or a key that is not text.
    """
    return _parse(text, origin)[0]


def _parse(text: str, origin: str) -> tuple[Any, list[str]]:
    """The document, and the keys of its top level that have no value."""
    loader = None
    try:
        loader = _StrictLoader(text)
        node = loader.get_single_node()
        if node is None:
            return None, []
        _check_size(node)
        pairs = node.value if isinstance(node, yaml.MappingNode) else ()
        empty = [
            key.value
            for key, value in pairs
            if isinstance(value, yaml.ScalarNode) and not value.end_mark.index - value.start_mark.index
        ]
        return loader.construct_document(node), empty
    except yaml.constructor.ConstructorError as error:
        problem = error.problem or "a value cannot be read"
        if "could not determine a constructor" in problem:
            tag = problem.rpartition("tag ")[2].replace("tag:yaml.org,2002:", "!!")
            problem = f"the tag {tag} is refused: configurations are plain data and never run code"
        raise InputError(f"{origin}: {problem}{_place(error)}.") from error
    except yaml.MarkedYAMLError as error:
        problem = error.problem or "it cannot be parsed"
        if problem.startswith("but "):  # PyYAML's sentence begins in the context
            problem = f"{error.context}, {problem}"
        raise InputError(f"{origin} is not valid YAML: {problem}{_place(error)}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        what = "nested too deeply" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        raise InputError(f"{origin} is not valid YAML: {what}.") from error
    finally:
        if loader is not None:
            loader.dispose()


def _check_size(root: yaml.Node) -> None:
    """Refuse deep nesting, and aliases that expand to more than any configuration holds.

    Raises:
        ValueError: There is too much of either.
    """
    sizes: dict[int, int] = {}

    def size(node: yaml.Node, depth: int) -> int:
        if depth > _DEEPEST:
            raise ValueError("nested too deeply")
        if id(node) not in sizes:
            sizes[id(node)] = 0  # a node that contains itself is refused when it is constructed
            inner = node.value if isinstance(node, yaml.CollectionNode) else ()
            parts = (part for item in inner for part in (item if isinstance(item, tuple) else (item,)))
            sizes[id(node)] = 1 + sum(size(part, depth + 1) for part in parts)
        return sizes[id(node)]

    if size(root, 0) > _MOST_VALUES:
        raise ValueError(f"its aliases expand to more than {_MOST_VALUES:,} values")


def read_mapping(file: Path, empty: Any = None) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping; an empty file gives an empty mapping.

    Args:
        file: The file.
        empty: Value of a top-level key that has nothing after its colon.

    Raises:
        InputError: The file cannot be read, is too long, is not text, or holds something other than a mapping.
    """
    try:
        with file.open("rb") as opened:
            content = opened.read(_LONGEST + 1)
        if len(content) > _LONGEST:
            raise InputError(
                f"{file} is longer than {_LONGEST >> 10} KiB, too long for a configuration; give another file."
            )
        text = content.decode("utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"The configuration file {file} does not exist.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not a text file; a configuration is YAML in UTF-8.") from error
    except OSError as error:
        raise InputError(f"The configuration file {file} cannot be read: {error.strerror}.") from error
    data, left_empty = _parse(text, str(file))
    if data is None:
        return {}
    if not isinstance(data, dict):
        kind = "a list" if isinstance(data, list) else "a single value"
        raise InputError(
            f"{file} has {kind} at its top level; a configuration is a mapping such as 'tracker: csrt'."
        )
    return {**data, **dict.fromkeys(left_empty, empty)}


def _place(error: yaml.MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    return f" (line {mark.line + 1}, column {mark.column + 1})" if mark else ""
