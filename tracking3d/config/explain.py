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
    """The valid name that is most similar to ``name``, or None if none is close."""
    by_lower = {candidate.lower(): candidate for candidate in valid}
    matches = difflib.get_close_matches(name.lower(), by_lower, n=1)
    return by_lower[matches[0]] if matches else None


def hint(name: str, valid: Iterable[str]) -> str:
    """Advice on what to write instead of ``name``: the nearest valid name, or all of them."""
    names = sorted(valid)
    if best := nearest(name, names):
        return f"did you mean '{best}'?"
    return f"valid are {', '.join(names)}." if names else "nothing can be given here."


def format_value(value: Any) -> str:
    """``value`` as messages show it, at most one line long."""
    short = reprlib.Repr()
    short.maxstring = short.maxother = 60
    return short.repr(value)


def a_kind(value: Any) -> str:
    """The kind of ``value``, with its article: ``a list``, ``None``, ``a VideoCapture``."""
    if value is None:
        return "None"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if isinstance(value, str):
        return "text"
    name = type(value).__name__.replace("ndarray", "array")
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"


def describe_validation_error(error: ValidationError, model: type[BaseModel], noun: str = "setting") -> str:
    """Explain in one sentence what is wrong with the values given for ``model``.

    Args:
        error: What pydantic raised. An unknown key is reported first, because it often explains the rest.
        model: The model that was validated.
        noun: Word for a key of this model.

    Returns:
        A sentence that begins with a small letter and contains the dotted path of the key.
    """
    problems = error.errors(include_url=False)
    unknown = [p["loc"] for p in problems if p["type"] == "extra_forbidden"]
    if unknown:
        unknown_names = [loc[-1] for loc in unknown if loc[:-1] == unknown[0][:-1]]
        return unknown_key(unknown[0], model, noun, unknown_names)
    problem = problems[0]
    path, message, given = _reach(model, problem["loc"]).path, problem["msg"], format_value(problem["input"])
    match problem["type"]:
        case "missing":
            return f"the {noun} '{path}' is missing; it is required."
        case "model_type" | "model_attributes_type" | "dict_type" if problem["input"] is None:
            return f"'{path}' must be a mapping of {noun}s, not null; to change nothing, leave it out."
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"'{path}' must be a mapping of {noun}s, not {given}."
        case "union_tag_invalid":
            allowed = problem["ctx"]["expected_tags"].replace(", ", " or ")
            return f"'{path}.name' must be {allowed}, not {format_value(problem['input'].get('name'))}."
    if message.startswith("Input should be "):
        allowed = re.sub(r", (unable|got) .*", "", message.removeprefix("Input should be "))
        return f"'{path}' must be {allowed}, not {given}."
    return f"'{path}' is {given}: {message.removeprefix('Value error, ').rstrip('.')}."


def unknown_key(
    loc: Sequence[int | str],
    model: type[BaseModel],
    noun: str = "setting",
    unknown_names: Sequence[int | str] = (),
) -> str:
    """Explain that a key does not exist, and which one is meant: a sibling, or the same name in another section.

    Args:
        loc: Path of the key.
        model: The model that was validated.
        noun: Word for a key of this model.
        unknown_names: All unknown keys of that section, if the name of the section chooses its settings.
    """
    *above, key = map(str, loc)
    section = _reach(model, above)
    if misplaced := section.of_another_choice([str(name) for name in unknown_names] or [key], noun):
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
    """The section that a path leads to."""

    path: str  # the path in dotted form
    model: type[BaseModel]  # the innermost model on the path
    choices: Mapping[str, type[BaseModel]]  # the models that the section's name chooses from, if it chooses

    def of_another_choice(self, keys: Sequence[str], noun: str) -> str | None:
        """Explain that ``keys`` are settings of another choice than the present one, if they are."""
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
                    f"'{self.path}.{name}' is not a section; write the {noun}s of the {self.path} '{name}' "
                    f"directly under '{self.path}', next to 'name: {name}'."
                )
        return None


def _reach(model: type[BaseModel], loc: Sequence[int | str]) -> _Section:
    """Follow a path of pydantic's; if a name chooses between models, its parts are the section and the choice."""
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
