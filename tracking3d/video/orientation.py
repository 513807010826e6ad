"""Rotating images upright: the eight EXIF orientations, which video display matrices share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tracking3d.frames import Image

UPRIGHT = 1
"""The EXIF orientation of an image that is stored upright."""

_TURNS: dict[int, Callable[[Image], Image]] = {
    1: lambda image: image,
    2: lambda image: image[:, ::-1],
    3: lambda image: image[::-1, ::-1],
    4: lambda image: image[::-1],
    5: lambda image: image.transpose(1, 0, 2),
    6: lambda image: np.rot90(image, -1),
    7: lambda image: image[::-1, ::-1].transpose(1, 0, 2),
    8: lambda image: np.rot90(image),
}

# By the signs of (a, b, c, d) where a stored pixel (x, y) is shown at (a x + c y, b x + d y).
_ORIENTATIONS = {
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}


def turn_upright(image: Image, orientation: int) -> Image:
    """Turn and mirror a stored picture so that it is as it is to be seen.

    Args:
        image: ``(H, W, 3)`` as stored.
        orientation: EXIF orientation 1 to 8 (Exif 2.32, tag 0x0112); any other value changes nothing.

    Returns:
        ``(H, W, 3)`` or ``(W, H, 3)``, contiguous.
    """
    return np.ascontiguousarray(_TURNS.get(orientation, _TURNS[UPRIGHT])(image))


def orientation_from_display_matrix(matrix: bytes) -> int:
    """The EXIF orientation that a video's display matrix asks for, to the nearest quarter turn.

    Args:
        matrix: Nine int32 in native byte order ``(a, b, u, c, d, v, x, y, w)``, as FFmpeg gives them
            (ISO/IEC 14496-12, 8.3.2; https://ffmpeg.org/doxygen/trunk/group__lavu__video__display.html).
    """
    a, b, _, c, d, *_ = np.frombuffer(matrix, np.int32, 9).astype(np.int64)
    if abs(a) + abs(d) >= abs(b) + abs(c):
        b = c = 0
    else:
        a = d = 0
    return _ORIENTATIONS.get((np.sign(a), np.sign(b), np.sign(c), np.sign(d)), UPRIGHT)
