"""Masks in image files, and what counts as the object in an array of values."""

from __future__ import annotations

import re
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.errors import InputError
from tracking3d.frames import OCCLUDER


class UnreadableMaskError(Exception):
    """One mask of many cannot be decoded; its frame is a gap."""


def natural_key(name: str) -> tuple[str | int, ...]:
    """A sort key in which numbers count as numbers: ``frame9`` before ``frame10``, ``7`` equal to ``007``."""
    return tuple(int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name))


def binarize(values: NDArray) -> NDArray[np.bool_]:
    """Object where a value is above half its type's range; if none is, wherever it is above zero.

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

    With an ``object``, images hold numbers instead of colours, as those of DAVIS and YouTube-VOS do: the object is
    where the palette's index, or the grey value, is that number.

    Args:
        path: What the user gave.
        files: The image files, in any order.
        object: Number of the object; None takes all that is not background.

    Raises:
        InputError: If none of the files is a readable image.
    """

    def __init__(self, path: Path, files: Sequence[Path], object: int | None = None) -> None:
        self._object = object
        self._files = sorted(files, key=lambda file: natural_key(file.name))
        self.names: Sequence[str] = [file.stem for file in self._files]
        if not any(self.shape(position) for position in range(len(files))):
            raise InputError(
                f"No image in {path} can be read as a mask; give one mask per frame, for example as PNG."
            )

    def label(self, position: int) -> str:
        """The file's path."""
        return str(self._files[position])

    def shape(self, position: int) -> tuple[int, int] | None:
        """``(H, W)`` by the file's header alone, or None if it cannot be read."""
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
                return _object_in(image) if self._object is None else _numbers_in(image) == self._object
        except Exception as error:  # decoders raise whatever a damaged file leads them to
            raise UnreadableMaskError(f"{self._files[position]} cannot be read") from error

    def read_occluder(self, position: int) -> NDArray[np.bool_] | None:
        """What is in front of the object, ``(H, W)``; None if a readable image does not say.

        Grey images say it that have `OCCLUDER` beside 0 and 255 and nothing else, as those of ``initial_masks/``.
        """
        if self._object is not None:
            return None
        with warnings.catch_warnings(action="ignore"), Pillow.open(self._files[position]) as image:
            levels = np.asarray(image) if image.mode == "L" else np.zeros((1, 1), np.uint8)
        occluder = levels == OCCLUDER
        return occluder if occluder.any() and (occluder | (levels == 0) | (levels == 255)).all() else None


def split_object(path: Path) -> tuple[Path, int | None]:
    """``FILE@N`` as file and number; the path as it is if it exists, or ends otherwise."""
    name, at, number = str(path).rpartition("@")
    if not at or not name or not re.fullmatch("[0-9]{1,9}", number) or path.exists():
        return path, None
    return Path(name), int(number)


def of_objects(numbers: Collection[Any], chosen: int | None, path: Path) -> Any:
    """Which of the objects of a file is meant; None if there is none at all.

    Raises:
        InputError: If the chosen one is not there, or there are several and none is chosen.
    """
    listed = ", ".join(str(one) for one in sorted(numbers, key=lambda one: natural_key(str(one)))[:12])
    if chosen is not None and chosen not in numbers:
        raise InputError(f"{path} has no object {chosen}; it has {listed or 'none'}.")
    if chosen is None and len(numbers) > 1:
        raise InputError(
            f"{path} has several objects ({listed}); choose one, as in {path}@{min(numbers, key=str)}."
        )
    return chosen if chosen is not None else next(iter(numbers), None)


def objects_in(path: Path) -> list[int]:
    """The numbers in an indexed image, 0 and the 255 that marks borders left out.

    Raises:
        InputError: If it cannot be read, or has colours instead.
    """
    try:
        with warnings.catch_warnings(action="ignore"), Pillow.open(path) as image:
            found = np.unique(_numbers_in(image))
    except Exception as error:  # decoders raise whatever a damaged file leads them to
        raise InputError(f"{path} cannot be read as an image with object numbers.") from error
    return [int(number) for number in found if number not in (0, 255)]


def _numbers_in(image: Pillow.Image) -> NDArray:
    """``(H, W)`` palette indices or grey values."""
    if image.mode not in ("1", "L", "P", "I", "I;16"):
        values = np.asarray(image.convert("RGB"))
        if not (values == values[..., :1]).all():
            raise ValueError("colours")
        return values[..., 0]
    return np.asarray(image)


def is_cut_out(file: Path) -> bool:
    """Whether an image's alpha says where its object is; False if it cannot be read."""
    try:
        with warnings.catch_warnings(action="ignore"), Pillow.open(file) as image:
            return _alpha_in(image) is not None
    except Exception:  # decoders raise whatever a damaged file leads them to
        return False


def _alpha_in(image: Pillow.Image) -> NDArray[np.uint8] | None:
    """``(H, W)`` alpha, also a palette's; None if there is none or it is the same everywhere, which says nothing."""
    if not image.has_transparency_data:
        return None
    alpha = np.asarray(image.convert("RGBA"))[..., 3]
    return alpha if alpha.min() != alpha.max() else None


def _object_in(image: Pillow.Image) -> NDArray[np.bool_]:
    if (alpha := _alpha_in(image)) is not None:
        return alpha > 127
    if image.mode == "P":
        return np.asarray(image.convert("RGB")).max(axis=2) > 0
    if image.mode == "I":  # 32-bit integers are how Pillow holds some 16-bit files
        return binarize(np.asarray(image).clip(0, 65535).astype(np.uint16))
    if image.mode in ("1", "L", "F") or image.mode.startswith("I;16"):
        return binarize(np.asarray(image))
    return binarize(np.asarray(image.convert("RGB")).max(axis=2))
