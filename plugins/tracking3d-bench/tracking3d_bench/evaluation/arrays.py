"""Checks of arrays passed to metrics; a wrong shape is the caller's mistake."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def floats(name: str, values: ArrayLike, *shape: int | None) -> NDArray[np.float64]:
    """``values`` as float64 of the given shape, None standing for any length.

    Raises:
        ValueError: If the shape is another; names both.
    """
    array = np.asarray(values, dtype=np.float64)
    check_shape(name, array.shape, *shape)
    return array


def finite(name: str, values: ArrayLike, *shape: int | None) -> NDArray[np.float64]:
    """As `floats`, without NaN or infinity.

    Raises:
        ValueError: If the shape is another, or a value is not finite.
    """
    array = floats(name, values, *shape)
    if not np.isfinite(array).all():
        raise ValueError(f"{name} {array.shape} has values that are not finite")
    return array


def booleans(name: str, values: ArrayLike, *shape: int | None) -> NDArray[np.bool_]:
    """``values`` of the given shape, None standing for any length.

    Raises:
        ValueError: If the shape is another, or the values are not bool: a label or a probability needs a decision
            that is not taken here.
    """
    array = np.asarray(values)
    if array.dtype != np.bool_:
        raise ValueError(f"{name} needs bool, got {array.dtype}")
    check_shape(name, array.shape, *shape)
    return array


def check_shape(name: str, actual: tuple[int, ...], *expected: int | None) -> None:
    """Compare two shapes, None standing for any length.

    Raises:
        ValueError: If they differ; names both.
    """
    fits = len(actual) == len(expected) and all(
        length is None or length == found for length, found in zip(expected, actual, strict=True)
    )
    if not fits:
        wanted = ", ".join("any" if length is None else str(length) for length in expected)
        raise ValueError(f"{name} needs shape ({wanted}), got {actual}")
