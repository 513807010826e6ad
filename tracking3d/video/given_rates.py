"""The frame rate that a user gives for images, which have no times of their own."""

from __future__ import annotations

from numbers import Real
from typing import Any

from tracking3d.errors import InputError, argument

FPS = argument("fps=", "--fps")
"""Its name in messages."""
LEAST_FPS, MOST_FPS = 0.001, 100_000.0
"""Images per second: from one in a quarter of an hour to the fastest cameras."""


def validate_fps(fps: Any) -> float | None:
    """The rate as a number; None if none is given.

    Raises:
        InputError: It is not a rate.
    """
    if fps is None:
        return None
    number = isinstance(fps, Real) and not isinstance(fps, bool)
    if not number or not LEAST_FPS <= fps <= MOST_FPS:
        raise InputError(
            f"{FPS} {fps!r:.40} is not a frame rate; give images per second from {LEAST_FPS:g} to {MOST_FPS:g}."
        )
    return float(fps)
