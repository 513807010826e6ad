"""Boxes: read from text, checked, and fitted into a frame."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any, Literal, get_args

from tracking3d.config.explain import format_value
from tracking3d.errors import InputError, argument
from tracking3d.frames import Box, Frame, pixels

_log = logging.getLogger(__name__)

BoxFormat = Literal["xywh", "xyxy"]
"""How a box is written: left and upper edge, then width and height, or then right and lower edge."""

BOX = argument("box=", "--box ")
"""Name of a box in messages, before its value."""

_FORMS = {"xywh": "X,Y,WIDTH,HEIGHT", "xyxy": "X1,Y1,X2,Y2"}
_SLACK_PIXELS, _SLACK_SHARE = 4.0, 0.02
"""How far a box may reach beyond the frame: so many pixels, or this share of the frame's side if that is more. What
programs and people draw is often that inexact; the part outside is cut off."""


def check_box_format(box_format: Any) -> BoxFormat:
    """The format of boxes, as its name.

    Raises:
        InputError: There is no such format.
    """
    if box_format not in get_args(BoxFormat):
        name = argument("box_format=", "--box-format ")
        raise InputError(
            f"{name}{format_value(box_format)} is not a format of boxes; give xywh (X,Y,WIDTH,HEIGHT) or xyxy "
            "(X1,Y1,X2,Y2)."
        )
    return box_format


def parse_box(text: str, name: str = BOX, box_format: BoxFormat = "xywh") -> Box:
    """Read a box from text.

    Args:
        text: ``X,Y,WIDTH,HEIGHT`` in pixels, or ``X1,Y1,X2,Y2``.
        name: Its name in messages.
        box_format: Which of the two it is.

    Returns:
        ``(x, y, width, height)``.

    Raises:
        InputError: The text is not four numbers, or the size is not positive.
    """
    form = _FORMS[check_box_format(box_format)]
    try:
        x, y, third, fourth = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{name}'{text}' is not four numbers; write it as {form} in pixels.") from error
    if box_format == "xywh":
        return validate_box((x, y, third, fourth), name)
    if third <= x or fourth <= y:
        raise InputError(
            f"{name}{text.strip()} has no size: as {form}, X2 must be more than X1, and Y2 more than Y1."
        )
    return validate_box((x, y, third - x, fourth - y), name)


def validate_box(box: Any, name: str = BOX) -> Box:
    """Four finite numbers, the last two positive.

    Args:
        box: ``(x, y, width, height)`` in pixels, of any kind of sequence.
        name: Its name in messages.

    Raises:
        InputError: It is anything else.
    """
    try:
        if isinstance(box, str | bytes | Mapping) or any(isinstance(value, str | bytes) for value in box):
            raise TypeError
        x, y, width, height = (float(value) for value in box)
    except Exception as error:  # iterating over a foreign object can raise anything
        raise InputError(
            f"{name}{format_value(box)} is not four numbers x, y, width, height in pixels."
        ) from error
    if not all(math.isfinite(value) for value in (x, y, width, height)):
        raise InputError(
            f"{name}{format_box((x, y, width, height))} has a value that is not a finite number; give four finite "
            "numbers."
        )
    if width <= 0 or height <= 0:
        raise InputError(
            f"{name}{format_box((x, y, width, height))} has no size; its width and height must be positive."
        )
    return x, y, width, height


def fit_box(box: Box, frame: Frame, name: str = BOX, box_format: BoxFormat = "xywh") -> Box:
    """The part of a box inside a frame; the log says if something was cut off.

    Raises:
        InputError: As `check_box_fits`.
    """
    inside = check_box_fits(box, frame.size, frame.label, name, box_format)
    if inside != box:
        _log.warning(
            "The box %s extends beyond the frame; the part inside, %s, is used.",
            format_box(box, box_format),
            format_box(inside, box_format),
        )
    return inside


def check_box_fits(
    box: Box, size: tuple[int, int], label: str, name: str = BOX, box_format: BoxFormat = "xywh"
) -> Box:
    """The part of a box inside a frame.

    Args:
        box: ``(x, y, width, height)`` in pixels.
        size: ``(height, width)`` of the frame.
        label: What messages call the frame.
        name: Name of the box in messages.
        box_format: How the box was written, and how messages write it.

    Raises:
        InputError: It lies outside, or reaches beyond the frame by more than a few pixels. If its numbers fit into the
            frame as right and lower edge, the sentence says so.
    """
    from tracking3d.trackers.crops import clip_box

    inside = clip_box(box, size)
    if inside is None:
        raise InputError(
            f"{name}{format_box(box, box_format)} lies outside {label}, which is {pixels(size)} pixels; "
            f"give the box as {_FORMS[box_format]}."
        )
    if beyond := _beyond(box, size, box_format):
        meant = (box[0], box[1], box[2] - box[0], box[3] - box[1])
        likely = box_format == "xywh" and min(meant[2:]) >= 1 and min(meant[:2]) >= 0
        if likely and not _beyond(meant, size, box_format):
            advice = f"did you mean {_FORMS['xywh']} = {format_box(meant)}?"
        else:
            advice = f"give the part inside {label}, which is {pixels(size)} pixels."
        raise InputError(f"{name}{format_box(box, box_format)} reaches beyond the frame ({beyond}); {advice}")
    return inside


def _beyond(box: Box, size: tuple[int, int], box_format: BoxFormat) -> str:
    """Where a box reaches beyond a frame by more than a few pixels, such as ``301+597 > 640``; empty if nowhere."""
    found = []
    for start, extent, side in zip(box[:2], box[2:], (size[1], size[0]), strict=True):
        slack = max(_SLACK_PIXELS, _SLACK_SHARE * side)
        if start < -slack:
            found.append(f"{start:g} < 0")
        if start + extent > side + slack:
            end = f"{start:g}+{extent:g}" if box_format == "xywh" else f"{start + extent:g}"
            found.append(f"{end} > {side}")
    return ", ".join(found)


def format_box(box: Box, box_format: BoxFormat = "xywh") -> str:
    """A box as text."""
    x, y, width, height = box
    values = box if box_format == "xywh" else (x, y, x + width, y + height)
    return ",".join(f"{value:g}" for value in values)
