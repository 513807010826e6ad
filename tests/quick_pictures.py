"""What every run draws for people to look at, in tests that do not look: small, in haste, and without text.

A run of a few frames takes longer to draw its video and its contact sheet than to be tracked. OpenCV alone takes 20 ms
to load its font in every thread that writes text, and every recording writes in a thread of its own.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tracking3d.results import contact_sheet, drawing
from tracking3d.video import writer


def _width(text: str, height: int) -> int:
    """As wide as text is, roughly."""
    return len(text) * height * 4 // 5


def _no_text(image: Any, text: str, left: int, base: int, height: int, colour: Any) -> int:
    return left + _width(text, height)


_QUICK: list[tuple[Any, str, Any]] = [
    (contact_sheet, "TILE", 80),
    (drawing, "draw_text", _no_text),
    (drawing, "text_width", _width),
    (writer, "_OPTIONS", {"libx264": {"crf": "20", "preset": "ultrafast", "tune": "zerolatency"}}),
]
_TRUE = [getattr(module, name) for module, name, _ in _QUICK]


def draw_quickly() -> None:
    """From here on."""
    for module, name, quick in _QUICK:
        setattr(module, name, quick)


@contextmanager
def draw_as_users_see_it() -> Iterator[None]:
    """Meanwhile pictures are what they are."""
    for (module, name, _), true in zip(_QUICK, _TRUE, strict=True):
        setattr(module, name, true)
    yield
    draw_quickly()
