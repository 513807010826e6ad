"""Kernel of `tracking3d.trackers.colour_models`: how often each pixel's own colour lies around it, in one pass."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import OPTIONS, kernel


def local_shares(
    labels: NDArray[np.uint8],
    last_labels: NDArray[np.uint8],
    last_mask: NDArray[np.float32],
    radius: int,
    size: int,
) -> NDArray[np.float32]:
    """See `tracking3d.trackers.colour_models`; ``size`` is more than any label."""
    shares = np.empty((2, *labels.shape), np.float32)
    labels, last_labels = (np.ascontiguousarray(part, np.uint8) for part in (labels, last_labels))
    _local_shares(labels, last_labels, np.ascontiguousarray(last_mask, np.float32), radius, size, shares)
    return shares


@numba.njit(**OPTIONS)
def _mirror(index, size):
    """The index that stands for one outside, as OpenCV's ``BORDER_REFLECT_101``."""
    while index < 0 or index >= size:
        index = -index if index < 0 else 2 * (size - 1) - index
        if size == 1:
            return 0
    return index


@kernel("void(uint8[:,::1], uint8[:,::1], float32[:,::1], int64, int64, float32[:,:,::1])")
def _local_shares(labels, last_labels, last_mask, radius, size, shares):
    height, width = labels.shape
    # What lies in each column within reach of the present row, mirrored at the borders as `cv2.blur` does.
    columns = np.zeros((2, size, width + 2 * radius), np.float64)
    for row in range(-radius, height + radius):
        added, removed = _mirror(row, height), _mirror(row - 2 * radius - 1, height)
        for place in range(width + 2 * radius):
            column = _mirror(place - radius, width)
            value = last_mask[added, column]
            columns[0, last_labels[added, column], place] += value
            columns[1, last_labels[added, column], place] += 1 - value
            if row > radius:
                value = last_mask[removed, column]
                columns[0, last_labels[removed, column], place] -= value
                columns[1, last_labels[removed, column], place] -= 1 - value
        at = row - radius
        if at < 0:
            continue
        for column in range(width):
            entry, inside, outside = labels[at, column], 0.0, 0.0
            for place in range(column, column + 2 * radius + 1):
                inside += columns[0, entry, place]
                outside += columns[1, entry, place]
            shares[0, at, column] = inside / (2 * radius + 1) ** 2
            shares[1, at, column] = outside / (2 * radius + 1) ** 2
