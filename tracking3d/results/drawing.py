"""Small drawing steps that the overlay and the contact sheet share; all of them draw into the image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.estimate import Status
from tracking3d.frames import Image

Colour = tuple[int, int, int]

INITIAL: Colour = (255, 150, 0)
REFINED: Colour = (0, 230, 255)
PAPER: Colour = (24, 24, 28)
INK: Colour = (235, 235, 235)
KEYFRAME: Colour = (255, 215, 0)
STATUS: dict[Status, Colour] = {
    Status.TRACKED: (90, 220, 110),
    Status.UNCERTAIN: (250, 200, 60),
    Status.LOST: (255, 85, 85),
}

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_CAPITAL = 22.0  # height of a capital letter at scale 1, in pixels


def draw_outline(image: Image, mask: NDArray[np.bool_], colour: Colour, thickness: int) -> None:
    """Draw the edges of ``mask`` ``(H, W)``, holes included."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(image, contours, -1, colour, thickness, cv2.LINE_AA)


def draw_text(image: Image, text: str, left: int, base: int, height: int, colour: Colour) -> int:
    """Write ``text`` on the line ``base``, capitals ``height`` pixels high; gives the column of its end."""
    weight = max(round(height / 10), 1)
    cv2.putText(image, _encodable(text), (left, base), _FONT, height / _CAPITAL, colour, weight, cv2.LINE_AA)
    return left + text_width(text, height)


def text_width(text: str, height: int) -> int:
    """Width in pixels of ``text`` as `draw_text` draws it."""
    weight = max(round(height / 10), 1)
    return int(cv2.getTextSize(_encodable(text), _FONT, height / _CAPITAL, weight)[0][0])


def shorten(text: str, height: int, width: int) -> str:
    """As many words of ``text`` as fit in ``width`` pixels, with "..." for the rest; empty if not even a word does.

    Of a single word too long, such as a path, its beginning is kept.
    """
    if text_width(text, height) <= width:
        return text
    words = text.split()
    kept = next(
        (
            short
            for count in range(len(words) - 1, 0, -1)
            if _fits(short := " ".join(words[:count]), height, width)
        ),
        "",
    )
    if kept:
        return kept + "..."
    letters = words[0] if words else ""
    while letters and not _fits(letters, height, width):
        letters = letters[:-1]
    return letters + "..." if len(letters) > 3 else ""


def wrap(text: str, height: int, width: int, most: int) -> list[str]:
    """``text`` in lines of at most ``width`` pixels, at most ``most`` of them; the last is shortened if need be."""
    words = text.split()
    lines: list[str] = []
    while words and len(lines) < most - 1:
        count = 1
        while count < len(words) and text_width(" ".join(words[: count + 1]), height) <= width:
            count += 1
        lines.append(shorten(" ".join(words[:count]), height, width))
        words = words[count:]
    return [*lines, shorten(" ".join(words), height, width)] if words else lines


def _fits(text: str, height: int, width: int) -> bool:
    """Whether ``text`` and the sign that some is left out fit."""
    return text_width(text + "...", height) <= width


def _encodable(text: str) -> str:
    """The text with ``?`` for what UTF-8 does not have, such as bytes of a path; OpenCV would end the process."""
    return text.encode("utf-8", "replace").decode("utf-8")


def fit(image: Image, size: int) -> Image:
    """The image scaled to fit a square tile ``(size, size, 3)``, centred."""
    height, width = image.shape[:2]
    scale = size / max(height, width)
    inner = max(round(width * scale), 1), max(round(height * scale), 1)
    scaled = cv2.resize(image, inner, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    tile = np.full((size, size, 3), PAPER, dtype=np.uint8)
    top, left = (size - inner[1]) // 2, (size - inner[0]) // 2
    tile[top : top + inner[1], left : left + inner[0]] = scaled
    return tile
