"""Backgrounds: painted clutter, or an image from the user's folder."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.errors import InputError
from tracking3d.testing.synthesis.procedural_texture import paint_background
from tracking3d.video.image_file import read_image
from tracking3d.video.image_sequence import images_among
from tracking3d_bench.synthesis.spec import PROCEDURAL_BACKGROUND, SequenceSpec


def make_background(spec: SequenceSpec) -> NDArray[np.float32]:
    """The background ``(H, W, 3)`` in [0, 255]; the seed chooses among images, which are scaled and cropped.

    Raises:
        InputError: If the folder holds no image, or the chosen one cannot be read.
    """
    rng = spec.random("background")
    width, height = spec.size
    if spec.background == PROCEDURAL_BACKGROUND:
        return paint_background(rng, width, height)
    folder = Path(spec.background)
    files = images_among(folder.iterdir()) if folder.is_dir() else []
    if not files:
        raise InputError(
            f"The background '{folder}' is not a folder of images; give one, or {PROCEDURAL_BACKGROUND}."
        )
    image = read_image(files[rng.integers(len(files))])
    scale = max(width / image.shape[1], height / image.shape[0])
    size = max(width, round(scale * image.shape[1])), max(height, round(scale * image.shape[0]))
    fitted = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    return fitted[top : top + height, left : left + width].astype(np.float32)
