"""Masks on disk in any supported form: opened cheaply, decoded one at a time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.trackers.coco_masks import CocoMasks
from tracking3d.trackers.mask_images import ImageMasks, UnreadableMaskError, natural_key
from tracking3d.trackers.mask_stacks import ArrayMasks, VideoMasks
from tracking3d.trackers.region_masks import RegionMasks

__all__ = ["ImageMasks", "MaskFiles", "UnreadableMaskError", "natural_key", "open_masks"]

# fmt: off
_SUFFIXES = frozenset((
    ".avif", ".bmp", ".gif", ".jp2", ".jpeg", ".jpg", ".pbm",
    ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp",
))
# fmt: on


class MaskFiles(Protocol):
    """Masks in their natural order."""

    # what each mask is called, without folder and suffix; empty if masks are only in order
    names: Sequence[str]

    def read(self, position: int) -> NDArray[np.bool_] | None:
        """Mask ``position`` as ``(H, W)`` bool, None beyond the last. Raises `UnreadableMaskError`."""
        ...

    def label(self, position: int) -> str:
        """What messages call mask ``position``."""
        ...


def open_masks(path: Path, object: int | None = None) -> MaskFiles:
    """Open a folder of images, a single image, an ``.npy`` or ``.npz`` file, or a video of masks.

    The results of other tools too: the folders of DAVIS and YouTube-VOS (one video), COCO's JSON, VOT's text.

    Args:
        path: What the user gave.
        object: Which object, if there are several: its palette index, or its number in COCO's file.

    Raises:
        InputError: If there is nothing at ``path``, no mask in it, or several objects of which none is chosen.
    """
    if not path.exists():
        raise InputError(
            f"{path} holds no masks; give a folder, a video, an .npz or an .npy file, COCO's .json or "
            "VOT's .txt."
        )
    if path.is_dir():
        folder = _of_one_video(path)
        return ImageMasks(folder, [file for file in folder.iterdir() if _is_image(file)], object)
    if _is_image(path):
        return ImageMasks(path, [path], object)
    suffix = path.suffix.lower()
    if suffix == ".json":
        return CocoMasks(path, object)
    if object is not None:
        raise InputError(f"{path} holds masks of one object; leave out the object number ({object}).")
    if suffix == ".txt":
        return RegionMasks(path)
    return ArrayMasks(path) if suffix in (".npy", ".npz") else VideoMasks(path)


def _of_one_video(path: Path) -> Path:
    """The folder of images that is meant by that of a data set.

    Raises:
        InputError: If it is of several videos.
    """
    inner = path / "Annotations" if (path / "Annotations").is_dir() else path
    if any(map(_is_image, inner.iterdir())):
        return inner
    folders = sorted(
        folder for folder in inner.iterdir() if folder.is_dir() and any(map(_is_image, folder.iterdir()))
    )
    if len(folders) > 1:
        names = ", ".join(folder.name for folder in folders[:4])
        raise InputError(
            f"{path} has masks of several videos ({names}...); give the folder of one: {folders[0]}."
        )
    return folders[0] if folders else path


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in _SUFFIXES and not path.name.startswith(".") and path.is_file()
