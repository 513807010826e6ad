"""Configuration in YAML: plain data only, every key once, and one sentence for every mistake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from tracking3d.config.explain import shown
from tracking3d.errors import InputError

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
                None, None, f"the key {shown(key)} is not text", key_node.start_mark
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
    return _parsed(text, origin)[0]


def _parsed(text: str, origin: str) -> tuple[Any, list[str]]:
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
    data, left_empty = _parsed(text, str(file))
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
