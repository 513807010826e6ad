"""YAML as configuration: plain data only, every key once, and one sentence for whatever is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from tracking3d.config.explain import shown
from tracking3d.errors import InputError


class _StrictLoader(yaml.SafeLoader):
    """PyYAML's safe loader (no tag runs code), which also refuses keys given twice or not as text."""


def _mapping(loader: _StrictLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[str] = set()
    for key_node, _ in node.value:
        if key_node.tag == "tag:yaml.org,2002:merge":
            continue
        key = loader.construct_object(key_node, deep=True)
        if not isinstance(key, str):
            raise yaml.constructor.ConstructorError(
                None, None, f"the key {shown(key)} is not text", key_node.start_mark
            )
        if key in seen:
            raise yaml.constructor.ConstructorError(
                None, None, f"the key '{key}' is given twice", key_node.start_mark
            )
        seen.add(key)
    # deep, so that a mapping that contains itself is found here instead of followed for ever elsewhere
    return loader.construct_mapping(node, deep=True)


_StrictLoader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def parse_yaml(text: str, origin: str) -> Any:
    """Parse one YAML document.

    Args:
        text: The document.
        origin: What messages call it, such as the file's name.

    Raises:
        InputError: Not YAML, a tag that is not plain data, a key given twice or a key that is not text.
    """
    try:
        return yaml.load(text, Loader=_StrictLoader)
    except yaml.constructor.ConstructorError as error:
        problem = error.problem or "a value cannot be read"
        if "could not determine a constructor" in problem:
            tag = problem.rpartition("tag ")[2].replace("tag:yaml.org,2002:", "!!")
            problem = f"the tag {tag} is refused: configurations are plain data and never run code"
        raise InputError(f"{origin}: {problem}{_place(error)}.") from error
    except yaml.MarkedYAMLError as error:
        problem = error.problem or "it cannot be parsed"
        if problem.startswith("but "):  # PyYAML's sentence began in the context
            problem = f"{error.context}, {problem}"
        raise InputError(f"{origin} is not valid YAML: {problem}{_place(error)}.") from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        what = "nested too deeply" if isinstance(error, RecursionError) else str(error).splitlines()[0]
        raise InputError(f"{origin} is not valid YAML: {what}.") from error


def read_mapping(file: Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping; an empty file is an empty mapping.

    Raises:
        InputError: The file cannot be read, is not text, or holds something other than a mapping.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"The configuration file {file} does not exist.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{file} is not a text file; a configuration is YAML in UTF-8.") from error
    except OSError as error:
        raise InputError(f"The configuration file {file} cannot be read: {error.strerror}.") from error
    data = parse_yaml(text, str(file))
    if data is None:
        return {}
    if not isinstance(data, dict):
        kind = "a list" if isinstance(data, list) else "a single value"
        raise InputError(
            f"{file} holds {kind} at its top level; a configuration is a mapping such as 'tracker: csrt'."
        )
    return data


def _place(error: yaml.MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    return f" (line {mark.line + 1}, column {mark.column + 1})" if mark else ""
