"""How often a pixel's colour lies around it, label by label with box filters."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray


def local_shares(
    labels: NDArray[np.uint8],
    last_labels: NDArray[np.uint8],
    last_mask: NDArray[np.float32],
    radius: int,
) -> NDArray[np.float32]:
    """See `tracking3d.trackers.colour_models.local_shares`."""
    side = (2 * radius + 1,) * 2
    shares = np.zeros((2, *labels.shape), np.float32)
    for entry in np.unique(labels):
        here, where = last_labels == entry, labels == entry
        for share, part in zip(shares, (last_mask, 1 - last_mask), strict=True):
            share[where] = cv2.blur(here * part, side)[where]
    return shares


def alike_around(labels: NDArray[np.uint8], mask: NDArray[np.bool_], radius: int) -> NDArray[np.float32]:
    """See `tracking3d.estimation.segmentation.colour_models.alike_around`."""
    sides = np.stack([mask, ~mask]).astype(np.float32)
    total = np.maximum(np.stack([cv2.blur(one, (2 * radius + 1,) * 2) for one in sides]), 0.02)
    return local_shares(labels, labels, sides[0], radius) / total
