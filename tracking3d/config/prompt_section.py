"""The section ``prompt`` of a configuration file: the prompt, written as for ``tracking3d run``.

It belongs to one video, not to the pipeline, so only ``run`` reads it.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from tracking3d.config.section import Section


def _one_or_several(value: Any) -> Any:
    return (value,) if isinstance(value, str) else value


Texts = Annotated[tuple[str, ...], BeforeValidator(_one_or_several)]
"""One text or a list of them."""


class PromptSection(Section):
    """The objects to track; every value is written as on the command line."""

    box: Texts = Field(
        (), description="Box X,Y,W,H of the object in the first frame, or a list for several objects."
    )
    box_format: Literal["xywh", "xyxy"] | None = Field(
        None,
        description="How boxes are written here: xywh (X,Y,WIDTH,HEIGHT, the default) or xyxy (X1,Y1,X2,Y2).",
    )
    mask: Texts = Field(
        (), description="Mask file of the object in the first frame, or a list for several objects."
    )
    points: Texts = Field(
        (), description="Points 'X,Y+ X,Y-' in the first frame, or a list for several objects."
    )
    start_frame: int | None = Field(None, ge=0, description="Frame of the prompt, if not the first.")
    correct: Texts = Field(
        (), description="Correction FRAME:BOX, FRAME:MASK or FRAME:POINTS, or a list of several."
    )
