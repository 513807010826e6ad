"""Masks on disk, whatever holds them: opened cheaply, decoded one at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.trackers.mask_images import ImageMasks, UnreadableMaskError, natural_key
from tracking3d.trackers.mask_stacks import ArrayMasks, VideoMasks

__all__ = ["ImageMasks", "MaskFiles", "UnreadableMaskError", "natural_key", "open_masks"]

# fmt: off
_SUFFIXES = frozenset((
    ".avif", ".bmp", ".gif", ".jp2", ".jpeg", ".jpg", ".pbm",
    ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp",
))
# fmt: on


class MaskFiles(Protocol):
    """Masks in their natural order.

    Attributes:
        names: What each mask is called, without folder and suffix; empty where masks are only in order.
    """

    names: Sequence[str]

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """Mask ``position`` as ``(H, W)`` bool, None beyond the last. Raises `UnreadableMaskError`."""
        ...

    def label(self, position: int) -> str:
        """What messages call mask ``position``."""
        ...


def open_masks(path: Path) -> MaskFiles:
    """Open a folder of images, a single image, an ``.npy`` or ``.npz`` file, or a video of masks.

    Raises:
        InputError: If there is nothing at ``path``, or no mask in it.
    """
    if not path.exists():
        raise InputError(f"There are no masks at {path}; give a folder, a video, an .npz or an .npy file.")
    if path.is_dir():
        return ImageMasks(path, [file for file in path.iterdir() if _is_image(file)])
    if _is_image(path):
        return ImageMasks(path, [path])
    return ArrayMasks(path) if path.suffix.lower() in (".npy", ".npz") else VideoMasks(path)


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and not path.name.startswith(".") and path.is_file()
