"""Point prompts: points on the object and on the background, read and checked."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tracking3d.config.explain import a_kind, format_value
from tracking3d.errors import InputError, argument
from tracking3d.frames import Frame, Prompt, pixels

POINTS = argument("points=", "--points ")
"""Their name in messages, before their values."""
MOST = 1000
"""Maximum number of points of one object in one frame."""

_FORM = (
    "'X,Y+ X,Y-' in pixels, + on the object and - on the background, for example '320,210+ 300,190+ 40,60-'"
)
_TOKEN = re.compile(r"([^,\s]+),([^,\s]+)([+-])")


def looks_like_points(text: str) -> bool:
    """Whether a text is meant as points: every word of it ends in + or -."""
    words = text.split()
    return bool(words) and all(word.endswith(("+", "-")) for word in words)


def parse_points(text: str, name: str = POINTS) -> NDArray[np.float32]:
    """Read ``X,Y+ X,Y-``: x and y in pixels, + on the object and - on the background.

    Args:
        text: The points, separated by spaces.
        name: Their name in messages.

    Returns:
        ``(N, 3)``: x, y, and 1 on the object or 0 on the background.

    Raises:
        InputError: The text is not of that form, or the points cannot be used.
    """
    rows = []
    for word in text.split():
        found = _TOKEN.fullmatch(word)
        try:
            if found is None:
                raise ValueError
            rows.append((float(found[1]), float(found[2]), 1.0 if found[3] == "+" else 0.0))
        except ValueError as error:
            raise InputError(f"{name}'{text}': '{word}' is not a point; write points as {_FORM}.") from error
    if not rows:
        raise InputError(f"{name}'{text}' has no point; write points as {_FORM}.")
    return _validate(rows, f"{name}'{text}'")


def validate_points(points: Any, name: str = POINTS) -> NDArray[np.float32]:
    """Check points: at least one is on the object, and they do not contradict each other.

    Args:
        points: ``(N, 3)`` of any kind of sequence: x, y in pixels, and 1 (or true) on the object, 0 on the background.
        name: Their name in messages.

    Raises:
        InputError: They are anything else.
    """
    return _validate(points, f"{name}{format_value(points)}")


def _validate(points: Any, said: str) -> NDArray[np.float32]:
    """The same; ``said`` names the given value in messages."""
    wanted = "give (x, y, 1) for each point on the object and (x, y, 0) for each on the background"
    try:
        if isinstance(points, str | bytes | Mapping):
            raise TypeError
        values = np.asarray([[float(value) for value in point] for point in points], dtype=np.float64)
    except Exception as error:  # iterating over a foreign object can raise anything
        raise InputError(f"{said} is {a_kind(points)}; {wanted}.") from error
    if values.ndim != 2 or values.shape[1] != 3 or not len(values):
        raise InputError(f"{said} is not a list of points; {wanted}.")
    if len(values) > MOST:
        raise InputError(f"{said} has {len(values)} points; give at most {MOST}.")
    if not np.isfinite(values).all() or np.abs(values).max() > 1e6:
        raise InputError(f"{said} has a coordinate that is not a number of pixels; {wanted}.")
    if not np.isin(values[:, 2], (0, 1)).all():
        raise InputError(f"{said} has a point whose label is neither 1 nor 0; {wanted}.")
    on = values[:, 2] == 1
    if not on.any():
        raise InputError(f"{said} has no point on the object; give at least one, X,Y+ on the command line.")
    gaps = np.linalg.norm(values[on, None, :2] - values[None, ~on, :2], axis=-1)
    if gaps.size and gaps.min() < 1:
        x, y = values[on][np.unravel_index(gaps.argmin(), gaps.shape)[0], :2]
        raise InputError(
            f"{said} has the point {x:g},{y:g} both on the object and on the background; leave out one of the two."
        )
    return values.astype(np.float32)


def check_points_inside(
    points: NDArray[np.float32], size: tuple[int, int], label: str, name: str = POINTS
) -> None:
    """Make sure that points are inside a frame of ``size`` ``(height, width)``, which messages call ``label``.

    Raises:
        InputError: One is not; it is named.
    """
    height, width = size
    for x, y, _ in points:
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            raise InputError(f"{name}{x:g},{y:g} lies outside {label}, which is {pixels(size)} pixels.")


def points_prompt(frame: Frame, points: Any, name: str = POINTS) -> Prompt:
    """Make a prompt from points in a frame, with a mask that is segmented from them.

    Args:
        frame: The frame.
        points: See `validate_points`.
        name: Their name in messages.

    Raises:
        InputError: They cannot be used, or do not separate the object from the background.
    """
    from tracking3d.trackers.crops import box_of
    from tracking3d.trackers.mask_from_points import mask_from_points

    checked = validate_points(points, name)
    check_points_inside(checked, frame.size, frame.label, name)
    mask = mask_from_points(frame.image, checked) > 0.5
    around = box_of(mask)
    if around is None or mask.all():
        raise InputError(
            f"{name}{format_value(points)}: these points do not separate an object from the background in "
            f"{frame.label}; give more points, some of them on the background, or a box."
        )
    return Prompt(around, mask, checked)
