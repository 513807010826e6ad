"""Numbers in the text of an option."""

from __future__ import annotations

import math

from tracking3d.errors import InputError


def numbers(text: str, count: int, option: str, form: str) -> tuple[float, ...]:
    """Read ``count`` finite numbers that are separated by commas.

    Raises:
        InputError: The text is anything else; the sentence names the ``option`` and its ``form``.
    """
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) != count or not all(map(math.isfinite, values)):
        count_in_words = "a number" if count == 1 else f"{count} numbers"
        raise InputError(f"{option} '{text}' is not {count_in_words}; write it as {form}.")
    return values
