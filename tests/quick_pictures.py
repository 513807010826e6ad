"""What every run draws for people to look at, in tests that do not look: as little and as seldom as shows the same.

A run of a few frames takes longer to draw its video and its contact sheet than to be tracked.
"""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from tracking3d.results import contact_sheet, drawing
from tracking3d.video import writer

_WHOLE = contact_sheet.TILE
_SMALL = 80
_NAME = "the one that draws text"


def draw_quickly() -> None:
    """Small contact sheets, an encoder in haste, and a font that is loaded once."""
    contact_sheet.TILE = _SMALL
    writer._OPTIONS["libx264"]["preset"] = "ultrafast"
    drawing.draw_text = _in_one_thread(drawing.draw_text)
    drawing.text_width = _in_one_thread(drawing.text_width)


@contextmanager
def whole_contact_sheets() -> Iterator[None]:
    """Contact sheets as users see them."""
    contact_sheet.TILE = _WHOLE
    yield
    contact_sheet.TILE = _SMALL


@functools.cache
def _thread(process: int) -> ThreadPoolExecutor:
    """A fork has a thread of its own."""
    return ThreadPoolExecutor(1, _NAME)


def _in_one_thread(function: Callable[..., Any]) -> Callable[..., Any]:
    """OpenCV loads its font in every thread that writes text, in 20 ms, and every recording writes in a new one."""

    @functools.wraps(function)
    def wrapper(*arguments: Any) -> Any:
        if threading.current_thread().name.startswith(_NAME):
            return function(*arguments)
        return _thread(os.getpid()).submit(function, *arguments).result()

    return wrapper
