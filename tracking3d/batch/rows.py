"""One video as a row of a table or as its JSON file: columns are named like the options of ``run``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, ValidationError

from tracking3d.config.explain import describe_validation_error
from tracking3d.config.section import Section
from tracking3d.errors import InputError
from tracking3d.prompts.boxes import BoxFormat

SEPARATOR = ";"
"""Between several values in one cell."""


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
    split: Annotated[str | None, BeforeValidator(_word)] = None
    settings: Annotated[tuple[str, ...], BeforeValidator(_settings)] = ()

    @property
    def has_prompt(self) -> bool:
        """Whether it says what the object is."""
        return bool(self.box or self.mask or self.points or self.masks)


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


def _empty(value: Any) -> bool:
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))
