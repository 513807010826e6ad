"""Cut-outs: what the teacher's masks cover, with an alpha channel and without the colours of its surroundings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from make_masks import LOGIT_SCALE

Image = NDArray[np.uint8]
Box = tuple[float, float, float, float]

_MIXED = 0.15
"""A mask that shares more with the hands is not one thing."""


@dataclass(frozen=True, eq=False)
class Masked:
    """A photograph and one thing in it.

    Attributes:
        image: ``(H, W, 3)`` RGB.
        soft: ``(H, W)`` float32 in [0, 1], the teacher's probability.
        box: ``(x, y, w, h)`` of the mask.
        quality: The IoU that the teacher expects.
        hands: ``(H, W)`` likewise, of all hands in the photograph; None if none was found.
    """

    image: Image
    soft: NDArray[np.float32]
    box: Box
    quality: float
    hands: NDArray[np.float32] | None = None


def read_masked(photos: Path, file: Path) -> list[Masked]:
    """Everything that the teacher found in the photograph of a mask file."""
    picture = cv2.imread(str(photos / file.parent.name / f"{file.stem}.jpg"))
    image = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    side = max(image.shape[:2])
    with np.load(file) as data:
        logits, boxes, quality = data["logits"], data["boxes"], data["quality"]
    found = []
    for grid, box, value in zip(logits, boxes, quality, strict=True):
        values = cv2.resize(
            grid.astype(np.float32) / LOGIT_SCALE, (side, side), interpolation=cv2.INTER_CUBIC
        )
        soft = 1 / (1 + np.exp(-1.5 * values[: image.shape[0], : image.shape[1]]))
        found.append(Masked(image, soft.astype(np.float32), tuple(map(float, box)), float(value)))
    return found


def with_hands(items: list[Masked], hands: list[Masked]) -> list[Masked]:
    """The things of one photograph that are no hands, nor partly hands, each with the hands beside it."""
    if not hands:
        return items
    together = np.max([hand.soft for hand in hands], axis=0)
    kept = []
    for item in items:
        common = np.minimum(item.soft, together).sum()
        if common < _MIXED * item.soft.sum() and common < _MIXED * together.sum():
            kept.append(replace(item, hands=together))
    return kept


def touched_sides(item: Masked) -> int:
    """How many of the photograph's sides the mask touches."""
    x, y, width, height = item.box
    rows, columns = item.image.shape[:2]
    return sum((x < 3, y < 3, x + width > columns - 3, y + height > rows - 3))


def cut_out(item: Masked, longest: int) -> Image:
    """``(h, w, 4)`` RGBA, the longer side ``longest`` pixels at most; beyond the outline its colours go on."""
    x, y, width, height = item.box
    margin = 4
    rows = slice(max(int(y) - margin, 0), int(y + height) + margin)
    columns = slice(max(int(x) - margin, 0), int(x + width) + margin)
    image, alpha = item.image[rows, columns], item.soft[rows, columns]
    scale = longest / max(image.shape[:2])
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        alpha = cv2.resize(alpha, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_AREA)
    # Half a pixel less than the teacher says: a rim of the old background would give the paste away.
    alpha = np.clip(1.6 * alpha - 0.6, 0, 1)
    image = _spread(image, alpha > 0.9)
    return np.dstack([image, np.round(255 * alpha).astype(np.uint8)])


def _spread(image: Image, inside: NDArray[np.bool_]) -> Image:
    """The colours inside, and beyond it that of the nearest pixel inside."""
    if not inside.any():
        return image
    _, labels = cv2.distanceTransformWithLabels(
        (~inside).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    rows, columns = np.nonzero(inside)
    table = np.zeros((labels.max() + 1, 3), np.uint8)
    table[labels[rows, columns]] = image[rows, columns]
    return table[labels]
