"""The section ``prompt`` of a configuration file: what is tracked, as the options of ``tracking3d run`` have it.

It belongs to one video and to no pipeline, so that only ``run`` reads it.
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from tracking3d.config.section import Section


def _one_or_several(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


Texts = Annotated[tuple[str, ...], BeforeValidator(_one_or_several)]
"""One text or a list of them."""


class PromptSection(Section):
    """What is tracked; every value is written as on the command line."""

    box: Texts = Field((), description="X,Y,W,H of an object in the first frame, or a list of several.")
    mask: Texts = Field((), description="Mask file of an object in the first frame, or a list of several.")
    points: Texts = Field(
        (), description="'X,Y+ X,Y-' of an object in the first frame, or a list of several."
    )
    start_frame: int | None = Field(None, ge=0, description="The frame in which the object is given.")
    correct: Texts = Field((), description="FRAME:BOX, FRAME:MASK or FRAME:POINTS, or a list of several.")
