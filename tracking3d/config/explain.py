"""Validation errors and unknown names in one sentence each, with the nearest valid name."""

from __future__ import annotations

import difflib
import re
import reprlib
import typing
from collections.abc import Iterable, Iterator, Sequence
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


def describe(error: ValidationError, model: type[BaseModel], noun: str = "setting") -> str:
    """Say in one sentence what is wrong with the values given for ``model``.

    Args:
        error: What pydantic raised. An unknown key is reported first, for it often explains the rest.
        model: The model that was validated.
        noun: What a key of this model is called.

    Returns:
        A sentence without a capital and with the dotted path of the key in it.
    """
    problems = error.errors(include_url=False)
    problem = next((p for p in problems if p["type"] == "extra_forbidden"), problems[0])
    path, message, given = _dotted(problem["loc"]), problem["msg"], shown(problem["input"])
    match problem["type"]:
        case "extra_forbidden":
            return unknown_key(problem["loc"], model, noun)
        case "missing":
            return f"the {noun} '{path}' is missing; it is required."
        case "model_type" | "model_attributes_type" | "dict_type":
            return f"'{path}' must be a mapping of {noun}s, not {given}."
    if message.startswith("Input should be "):
        allowed = re.sub(r", (unable|got) .*", "", message.removeprefix("Input should be "))
        return f"'{path}' must be {allowed}, not {given}."
    return f"'{path}' is {given}: {message.removeprefix('Value error, ').rstrip('.')}."


def unknown_key(loc: Sequence[int | str], model: type[BaseModel], noun: str = "setting") -> str:
    """Say that there is no such key, and which is meant: a sibling, or the same name in another section."""
    key = str(loc[-1])
    siblings = list(_model_at(model, loc[:-1]).model_fields)
    prefix = [str(part) for part in loc[:-1]]
    elsewhere = [path for path in _paths(model) if path.rpartition(".")[2] == key]
    if nearest(key, siblings) or not elsewhere:
        advice = hint(_dotted(loc), [_dotted([*prefix, name]) for name in siblings])
    else:
        advice = f"did you mean '{elsewhere[0]}'?"
    return f"there is no {noun} '{_dotted(loc)}'; {advice}"


def _dotted(loc: Sequence[int | str]) -> str:
    return ".".join(str(part) for part in loc)


def _model_in(annotation: Any) -> type[BaseModel] | None:
    """The model in an annotation such as ``Weights`` or ``Weights | None``."""
    for candidate in (annotation, *typing.get_args(annotation)):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def _model_at(model: type[BaseModel], loc: Sequence[int | str]) -> type[BaseModel]:
    """The nested model that the path leads to; the innermost known one where the path leaves the models."""
    for part in loc:
        field = model.model_fields.get(str(part))
        model = (field and _model_in(field.annotation)) or model
    return model


def _paths(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """The dotted path of every key below ``model``."""
    for name, field in model.model_fields.items():
        yield prefix + name
        if nested := _model_in(field.annotation):
            yield from _paths(nested, f"{prefix}{name}.")
