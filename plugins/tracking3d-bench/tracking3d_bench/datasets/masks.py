"""Masks as data sets store them, read on demand. See `tracking3d_bench.datasets.truth.MaskReference`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.errors import InputError
from tracking3d.trackers.vot_regions import Region, rasterise

Label = int | tuple[int, int, int]
"""A grey value or palette index, or a colour ``(red, green, blue)``."""


@dataclass(frozen=True)
class IndexedMask:
    """An image of labels, a palette PNG for example; the pixels with one label are the object.

    Attributes:
        path: The image.
        value: The object's label. None: every pixel that is not 0.
    """

    path: Path
    value: Label | None

    def read(self) -> NDArray[np.bool_]:
        """See `MaskReference.read`; empty if no pixel has the label."""
        labels = read_labels(self.path, colour=isinstance(self.value, tuple))
        if self.value is None:
            return labels != 0
        return (labels == self.value).all(axis=-1) if labels.ndim == 3 else labels == self.value


@dataclass(frozen=True, eq=False)
class RegionMask:
    """A region of a text file: an encoded mask, a rectangle, a polygon, or none, which is an empty mask.

    Attributes:
        region: The region.
        shape: ``(H, W)`` of the frame.
    """

    region: Region
    shape: tuple[int, int]

    def read(self) -> NDArray[np.bool_]:
        """See `MaskReference.read`."""
        return rasterise(self.region, self.shape)


def read_labels(path: Path, colour: bool = False) -> NDArray:
    """Read an image of labels.

    Args:
        path: The image.
        colour: Whether labels are colours.

    Returns:
        ``(H, W)`` palette indices or grey values, or ``(H, W, 3)`` uint8 RGB.

    Raises:
        InputError: If it is no readable image, or has colours although labels are numbers.
    """
    try:
        with Pillow.open(path, formats=["PNG", "BMP", "TIFF", "GIF", "JPEG", "PPM"]) as image:
            labels = np.asarray(image.convert("RGB") if colour else image)
    except Exception as error:  # decoders raise whatever a damaged file leads them to
        raise InputError(f"The mask {path} is not a readable image; restore or remove it.") from error
    if colour or labels.ndim == 2:
        return labels
    # Tools that know no palettes save grey values as three equal channels.
    if not (labels[..., :1] == labels[..., :3]).all():
        raise InputError(
            f"The mask {path} has colours instead of numbered labels; specify the colour of the object."
        )
    return labels[..., 0]
