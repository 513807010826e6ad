"""Masks in image files, and what counts as the object in an array of values."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.errors import InputError


class UnreadableMaskError(Exception):
    """One mask of many cannot be decoded; its frame is a gap."""


def natural_key(name: str) -> tuple[str | int, ...]:
    """A sort key in which numbers count as numbers: ``frame9`` before ``frame10``, ``7`` equal to ``007``."""
    return tuple(int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name))


def binarize(values: NDArray) -> NDArray[np.bool_]:
    """Object where a value is above half its type's range; where none is, wherever it is above zero.

    So masks of 0 and 255 lose what a lossy codec left in between, and masks of 0 and 1 or of small labels
    work too. Floats range from 0 to 1.

    Args:
        values: ``(H, W)`` bool, integers or floats.
    """
    if values.dtype == np.bool_:
        return values
    bright = values > (np.iinfo(values.dtype).max / 2 if values.dtype.kind in "iu" else 0.5)
    return bright if bright.any() else values > 0


class ImageMasks:
    """One image file a mask: any depth, grey, colour, palette or alpha.

    The object is where alpha is above half, if alpha varies; else where a palette's colour is not black; else
    where the brightest channel passes `binarize`.

    Args:
        path: What the user gave.
        files: The image files, in any order.

    Raises:
        InputError: If none of the files is a readable image.
    """

    def __init__(self, path: Path, files: Sequence[Path]) -> None:
        self._files = sorted(files, key=lambda file: natural_key(file.name))
        self.names: Sequence[str] = [file.stem for file in self._files]
        if not any(self.shape(position) for position in range(len(files))):
            raise InputError(
                f"No image in {path} can be read as a mask; put one mask a frame there, as PNG for example."
            )

    def label(self, position: int) -> str:
        """The file's path."""
        return str(self._files[position])

    def shape(self, position: int) -> tuple[int, int] | None:
        """``(H, W)`` by the file's header alone, or None where it cannot be read."""
        try:
            with warnings.catch_warnings(action="ignore"), Pillow.open(self._files[position]) as image:
                return image.height, image.width
        except (OSError, ValueError, SyntaxError, Pillow.DecompressionBombError):
            return None

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """See `MaskFiles.read`."""
        if position >= len(self._files):
            return None
        try:
            with warnings.catch_warnings(action="ignore"), Pillow.open(self._files[position]) as image:
                return _object_in(image)
        except Exception as error:  # decoders raise whatever a damaged file leads them to
            raise UnreadableMaskError(f"{self._files[position]} cannot be read") from error


def _object_in(image: Pillow.Image) -> NDArray[np.bool_]:
    if image.has_transparency_data and image.mode != "P":
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
        if alpha.min() != alpha.max():  # a cut-out; an alpha channel of one value says nothing
            return alpha > 127
    if image.mode == "P":
        return np.asarray(image.convert("RGB")).max(axis=2) > 0
    if image.mode == "I":  # 32-bit integers are how Pillow holds some 16-bit files
        return binarize(np.asarray(image).clip(0, 65535).astype(np.uint16))
    if image.mode in ("1", "L", "F") or image.mode.startswith("I;16"):
        return binarize(np.asarray(image))
    return binarize(np.asarray(image.convert("RGB")).max(axis=2))
