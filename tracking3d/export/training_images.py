"""Image and mask files for tools that reconstruct a scene from photographs."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from tracking3d.export.exported_run import ExportedRun
from tracking3d.frames import Image
from tracking3d.results.files import write_mask

_QUALITY = 95
_MARGIN = 16
"""Pixels around the mask that keep their colours under a transparent alpha, so that scaling does not darken edges."""


def picture_name(run: ExportedRun, index: int) -> str:
    """What the picture of a frame is called."""
    return f"{index:06d}.{'png' if run.options.cut_out else 'jpg'}"


def write_pictures(run: ExportedRun, images: Path, masks: Path, mask_name: str) -> None:
    """Write the pictures of all frames with a pose, and their masks: 255 is the object, 0 is to be ignored.

    With the option ``cut_out`` pictures are PNG with alpha, and masks are written all the same.

    Args:
        run: The run.
        images, masks: Folders; made.
        mask_name: Name of a mask, with ``{image}`` for the picture's name and ``{stem}`` for that without suffix.
    """
    posed = {one.index for one in run.poses}
    images.mkdir(parents=True)
    masks.mkdir(parents=True)
    for frame in run.pinhole_pictures():
        if frame.index not in posed:
            continue
        mask, name = run.pinhole_mask(frame.index), picture_name(run, frame.index)
        if run.options.cut_out:
            Pillow.fromarray(cut_out(frame.image, mask)).save(images / name)
        else:
            Pillow.fromarray(frame.image).save(images / name, quality=_QUALITY, subsampling=0)
        write_mask(masks / mask_name.format(image=name, stem=Path(name).stem), mask)


def cut_out(image: Image, mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """``(H, W, 4)`` RGB and straight alpha; the background is black, but for a margin around the object."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _MARGIN + 1, 2 * _MARGIN + 1))
    near = cv2.dilate(mask.astype(np.uint8), kernel)
    return np.dstack([image * near[..., None], mask.astype(np.uint8) * np.uint8(255)])
