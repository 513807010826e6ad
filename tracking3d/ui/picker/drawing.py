"""A user's drawing on a frame as received from the browser, validated and bounded before use."""

from __future__ import annotations

from typing import Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from tracking3d.errors import InputError

MOST_OBJECTS, MOST_POINTS, MOST_STROKES, LONGEST_STROKE = 16, 200, 400, 2000
_FARTHEST = 2**16

Pixel = Annotated[float, Field(ge=-_FARTHEST, le=_FARTHEST, allow_inf_nan=False)]
Extent = Annotated[float, Field(gt=0, le=_FARTHEST, allow_inf_nan=False)]


class _Drawn(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Point(_Drawn):
    """A click."""

    x: Pixel  # column in pixels
    y: Pixel  # row in pixels
    on: bool  # whether it is on the object, or on the background


class Stroke(_Drawn):
    """A line of the brush."""

    # its points (x, y) in pixels
    path: Annotated[tuple[tuple[Pixel, Pixel], ...], Field(min_length=1, max_length=LONGEST_STROKE)]
    radius: Extent  # radius of the brush, in pixels
    on: bool  # whether it adds to the mask, or takes away from it


class DrawnObject(_Drawn):
    """One object."""

    name: Annotated[str, Field(min_length=1, max_length=40)]  # what the person calls it
    # #rrggbb in which it is shown
    colour: Annotated[str, Field(pattern=r"^#[0-9a-f]{6}$")]
    frame: Annotated[int, Field(ge=0, le=2**31)]  # index of the frame that it was drawn on
    box: tuple[Pixel, Pixel, Extent, Extent] | None = None  # (x, y, width, height) in pixels, or None
    points: Annotated[tuple[Point, ...], Field(max_length=MOST_POINTS)] = ()  # the clicks
    strokes: Annotated[tuple[Stroke, ...], Field(max_length=MOST_STROKES)] = ()  # the paint, in order

    @field_validator("name")
    @classmethod
    def _one_line(cls, name: str) -> str:
        if not name.strip() or not name.isprintable():
            raise ValueError("the name has no letter, or a character that cannot be printed")
        return name.strip()

    @property
    def is_empty(self) -> bool:
        """Whether nothing was drawn."""
        return self.box is None and not self.points and not self.strokes

    @property
    def only_a_box(self) -> bool:
        """Whether a box says it all."""
        return self.box is not None and not self.points and not self.strokes


class Drawing(_Drawn):
    """All objects."""

    objects: Annotated[tuple[DrawnObject, ...], Field(min_length=1, max_length=MOST_OBJECTS)]


Sent = TypeVar("Sent", bound=BaseModel)


def parse(text: bytes, model: type[Sent], what: str = "drawing", it: str = "it") -> Sent:
    """What the page has sent as JSON.

    Args:
        text: The JSON.
        model: What it is.
        what: The word for it in messages.
        it: The pronoun.

    Raises:
        InputError: If it is none.
    """
    try:
        return model.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or it
        raise InputError(f"The {what} cannot be used: {where}: {first['msg']}.") from error
