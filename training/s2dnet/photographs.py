"""Photographs to train on, from packages that anyone can install."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp"}
_THUMBNAIL = 8  # two files with alike thumbnails are one picture at two sizes
_LEAST_DETAIL = 3.0  # mean absolute difference of neighbouring grey values, in a picture of 256 pixels


def find_photographs(folders: Sequence[Path], least_side: int, longest_side: int) -> list[Image]:
    """Every distinct picture with some detail under ``folders``, in the order of their paths.

    Args:
        folders: Searched with all that lies below them.
        least_side: Pictures with a shorter side are passed over, in pixels.
        longest_side: Larger pictures are reduced to it, in pixels.

    Returns:
        ``(H, W, 3)`` uint8 RGB each.
    """
    pictures = (cv2.cvtColor(p[..., :3], cv2.COLOR_BGR2RGB) for p in _pictures(folders))
    return _distinct(pictures, least_side, longest_side)


def find_cutouts(folders: Sequence[Path], least_side: int, longest_side: int) -> list[Image]:
    """As `find_photographs`, of pictures with transparent parts: ``(H, W, 4)`` uint8 RGBA each."""
    pictures = (cv2.cvtColor(p, cv2.COLOR_BGRA2RGBA) for p in _pictures(folders) if p.shape[2] == 4)
    return _distinct(pictures, least_side, longest_side)


def _pictures(folders: Sequence[Path]) -> Iterator[Image]:
    for folder in folders:
        if not folder.is_dir():
            raise SystemExit(f"{folder} is no folder; training/README.md says where to get it.")
        for file in sorted(folder.rglob("*")):
            if file.suffix.lower() not in _SUFFIXES or file.is_symlink():
                continue
            image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            if image is not None and image.ndim == 3 and image.dtype == np.uint8:
                yield image


def _distinct(pictures: Iterable[Image], least_side: int, longest_side: int) -> list[Image]:
    seen: set[bytes] = set()
    distinct = []
    for picture in pictures:
        if min(picture.shape[:2]) < least_side:
            continue
        scale = longest_side / max(picture.shape[:2])
        if scale < 1:
            picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        grey = cv2.cvtColor(picture[..., :3].copy(), cv2.COLOR_RGB2GRAY)
        thumbnail = cv2.resize(grey, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA)
        key = (thumbnail > thumbnail.mean()).tobytes()
        small = cv2.resize(grey, (256, 256), interpolation=cv2.INTER_AREA).astype(np.float32)
        detail = sum(np.abs(np.diff(small, axis=axis)).mean() for axis in (0, 1))
        if key not in seen and detail >= _LEAST_DETAIL:
            seen.add(key)
            distinct.append(picture)
    return distinct
