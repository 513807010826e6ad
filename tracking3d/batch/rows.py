"""One video as a row of a table or as its JSON file: columns are named like the options of ``run``."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationError

from tracking3d.config.explain import describe_validation_error
from tracking3d.config.models import Section
from tracking3d.errors import InputError
from tracking3d.trackers.prompts.boxes import BoxFormat

SEPARATOR = ";"
"""Between several values in one cell."""
_LONGEST = 120  # characters of a text in a message
_MOST = 10_000  # characters of a value; an error would quote all of them


def _texts(value: Any) -> Any:
    """Several texts: a list, or one text with semicolons; a box may also be four numbers."""
    if isinstance(value, str):
        parts = [part.strip() for part in value.split(SEPARATOR)]
        return tuple(part for part in parts if part)
    if isinstance(value, list | tuple):
        if value and all(isinstance(one, int | float) for one in value):
            return (_numbers(value),)
        return tuple(_numbers(one) if isinstance(one, list | tuple) else one for one in value)
    return value


def _settings(value: Any) -> Any:
    if isinstance(value, Mapping):
        return tuple(f"{key}={json.dumps(one)}" for key, one in value.items())
    return _texts(value)


def _text(value: Any) -> Any:
    return _numbers(value) if isinstance(value, list | tuple) else value


def _word(value: Any) -> Any:
    return f"{value:g}" if isinstance(value, int | float) else value


def _numbers(values: Any) -> Any:
    return ",".join(f"{one:.17g}" if isinstance(one, float) else str(one) for one in values)


Texts = Annotated[tuple[str, ...], BeforeValidator(_texts)]


class VideoRow(Section):
    """The row of one video; all but the video is optional."""

    video: str
    name: str | None = None
    box: Texts = ()
    box_format: BoxFormat | None = None
    mask: Texts = ()
    points: Texts = ()
    correct: Texts = ()
    masks: str | None = None
    start_frame: int | None = None
    frames: str | None = None
    fov: float | None = None
    intrinsics: Annotated[str | None, BeforeValidator(_text)] = None
    tracker: str | None = None
    features: str | None = None
    preset: str | None = None
    quality: str | None = None
    model: str | None = None
    split: Annotated[str | None, BeforeValidator(_word)] = None
    settings: Annotated[tuple[str, ...], BeforeValidator(_settings)] = ()

    @property
    def has_prompt(self) -> bool:
        """Whether it says what the object is."""
        return bool(self.box or self.mask or self.points or self.masks)


@dataclass(frozen=True)
class UnusableRow:
    """A row that cannot be used."""

    number: int  # its line
    video: str  # its video, as far as it can be printed
    reason: str  # what is wrong with it, in a sentence that names the line


def read_row(values: Mapping[str, Any], where: str) -> VideoRow:
    """A row from what a table or a JSON file holds; cells that are empty say nothing.

    Args:
        values: By the column's name.
        where: Name of the row in messages.

    Raises:
        InputError: If a column is unknown, or a value cannot be one.
    """
    given = {str(key): value for key, value in values.items() if not _empty(value)}
    try:
        return VideoRow.model_validate(given)
    except ValidationError as error:
        raise InputError(f"{where}: {describe_validation_error(error, VideoRow, 'column')}") from error
    except (OverflowError, RecursionError) as error:
        raise InputError(f"{where} holds a value that is too large or too deeply nested.") from error


def check_texts(values: Mapping[str, Any], where: str) -> None:
    """Check that texts from outside are texts: no path, table or page can hold others.

    Args:
        values: See `read_row`.
        where: See `read_row`.

    Raises:
        InputError: If a text holds NUL or half of a character or is very long, or values are nested too deeply.
    """
    try:
        for column, value in values.items():
            for text in _texts_in((column, value)):
                if "\0" in text:
                    raise InputError(f"{where}: column {printable(column)} holds a NUL character; remove it.")
                if len(text) > _MOST:
                    raise InputError(
                        f"{where}: column {printable(column)} has {len(text)} characters; shorten it."
                    )
                if not _is_unicode(text):
                    raise InputError(
                        f"{where}: column {printable(column)} is not valid Unicode; write the file as UTF-8."
                    )
    except RecursionError as error:
        raise InputError(f"{where} holds a value that is too deeply nested.") from error


def printable(text: str) -> str:
    """A text for a message: with escapes for what cannot be printed, and no longer than a line."""
    escaped = "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text[:_LONGEST])
    return escaped + "..." if len(text) > _LONGEST else escaped


def _texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from _texts_in(tuple(value.items()))
    elif isinstance(value, list | tuple):
        for one in value:
            yield from _texts_in(one)


def _is_unicode(text: str) -> bool:
    return not any("\ud800" <= sign <= "\udfff" for sign in text)


def _empty(value: Any) -> bool:
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))
