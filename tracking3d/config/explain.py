"""Validation errors and unknown names in one sentence each, with the nearest valid name."""

from __future__ import annotations

import difflib
import re
import reprlib
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError


def nearest(name: str, valid: Iterable[str]) -> str | None:
    """The valid name that looks most like ``name``, or None where nothing comes close."""
    by_lower = {candidate.lower(): candidate for candidate in valid}
    matches = difflib.get_close_matches(name.lower(), by_lower, n=1)
    return by_lower[matches[0]] if matches else None


def hint(name: str, valid: Iterable[str]) -> str:
    """What to write instead of ``name``: the nearest valid name, or all of them."""
    names = sorted(valid)
    if best := nearest(name, names):
        return f"did you mean '{best}'?"
    return f"valid are {', '.join(names)}." if names else "nothing can be given here."


def shown(value: Any) -> str:
    """``value`` as messages show it, never longer than a line."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    return short.repr(value)


def a_kind(value: Any) -> str:
    """What ``value`` is, with its article: ``a list``, ``None``, ``a VideoCapture``."""
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, str):
        return "text"
    name = type(value).__name__.replace("ndarray", "array")
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def describe_validation_error(error: ValidationError, model: type[BaseModel], noun: str = "setting") -> str:
    """Say in one sentence what is wrong with the values given for ``model``.

    Args:
        error: What pydantic raised. An unknown key is reported first, for it often explains the rest.
        model: The model that was validated.
        noun: What a key of this model is called.

    Returns:
        A sentence without a capital and with the dotted path of the key in it.
    """
    problems = error.errors(include_url=False)
    unknown = [p["loc"] for p in problems if p["type"] == "extra_forbidden"]
    if unknown:
        beside = [loc[-1] for loc in unknown if loc[:-1] == unknown[0][:-1]]
        return unknown_key(unknown[0], model, noun, beside)
    problem = problems[0]
    path, message, given = _reach(model, problem["loc"]).path, problem["msg"], shown(problem["input"])
    match problem["type"]:
        case "missing":
            return f"the {noun} '{path}' is missing; it is required."
        case "model_type" | "model_attributes_type" | "dict_type" if problem["input"] is None:
            return f"'{path}' must be a mapping of {noun}s, not null; leave it out to change nothing."
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"'{path}' must be a mapping of {noun}s, not {given}."
        case "union_tag_invalid":
            allowed = problem["ctx"]["expected_tags"].replace(", ", " or ")
            return f"'{path}.name' must be {allowed}, not {shown(problem['input'].get('name'))}."
    if message.startswith("Input should be "):
        allowed = re.sub(r", (unable|got) .*", "", message.removeprefix("Input should be "))
        return f"'{path}' must be {allowed}, not {given}."
    return f"'{path}' is {given}: {message.removeprefix('Value error, ').rstrip('.')}."


def unknown_key(
    loc: Sequence[int | str],
    model: type[BaseModel],
    noun: str = "setting",
    beside: Sequence[int | str] = (),
) -> str:
    """Say that there is no such key, and which is meant: a sibling, or the same name in another section.

    Args:
        loc: Where the key is.
        model: The model that was validated.
        noun: What a key of this model is called.
        beside: All unknown keys of that section, where a section has the settings of what its name chooses.
    """
    *above, key = map(str, loc)
    section = _reach(model, above)
    if misplaced := section.of_another_choice([str(name) for name in beside] or [key], noun):
        return misplaced
    prefix = f"{section.path}." if section.path else ""
    siblings = list(section.model.model_fields)
    elsewhere = [path for path in _paths(model) if path.rpartition(".")[2] == key]
    if nearest(key, siblings) or not elsewhere:
        advice = hint(prefix + key, [prefix + name for name in siblings])
    else:
        advice = f"did you mean '{elsewhere[0]}'?"
    return f"there is no {noun} '{prefix}{key}'; {advice}"


@dataclass(frozen=True)
class _Section:
    """Where a path leads to.

    Attributes:
        path: The path as it is written, with dots.
        model: The innermost model on the way.
        choices: What the section's ``name`` can choose, if it chooses.
    """

    path: str
    model: type[BaseModel]
    choices: Mapping[str, type[BaseModel]]

    def of_another_choice(self, keys: Sequence[str], noun: str) -> str | None:
        """Say of what the ``keys`` are settings, where that is something else than what is chosen."""
        for name, model in self.choices.items():
            written = [f"'{self.path}.{key}'" for key in keys if key in model.model_fields]
            if written and model is not self.model:
                named = ", ".join(written[:3]) + (f" and {len(written) - 3} more" * (len(written) > 3))
                are, them = ("is a", "it") if len(written) == 1 else ("are", "them")
                return (
                    f"{named} {are} {noun}{'s' * (len(written) > 1)} of the {self.path} '{name}', and the "
                    f"{self.path} is '{_choice_name(self.model)}'; leave {them} out, or choose '{name}' by "
                    f"'{self.path}.name'."
                )
            if name in keys:
                return (
                    f"'{self.path}.{name}' is no section any more; the {noun}s of the {self.path} '{name}' stand "
                    f"directly under '{self.path}', beside 'name: {name}'."
                )
        return None


def _reach(model: type[BaseModel], loc: Sequence[int | str]) -> _Section:
    """Follow a path of pydantic's; where a name chooses between models, its parts are the section and the choice."""
    path: list[str] = []
    choices: dict[str, type[BaseModel]] = {}
    for part in map(str, loc):
        if part in choices:
            model = choices[part]
            continue
        path.append(part)
        field = model.model_fields.get(part)
        models = _models_in(field.annotation) if field else []
        choices = {_choice_name(one): one for one in models} if field and field.discriminator else {}
        model = models[0] if models else model
    return _Section(".".join(path), model, choices)


def _choice_name(model: type[BaseModel]) -> str:
    return str(model.model_fields["name"].default)


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    """The models in an annotation such as ``Weights`` or ``Weights | None``."""
    candidates = (annotation, *typing.get_args(annotation))
    return [one for one in candidates if isinstance(one, type) and issubclass(one, BaseModel)]


def _paths(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """The dotted path of every key below ``model``."""
    for name, field in model.model_fields.items():
        yield prefix + name
        for nested in _models_in(field.annotation):
            yield from _paths(nested, f"{prefix}{name}.")
