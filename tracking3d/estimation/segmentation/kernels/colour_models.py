"""How often each pixel's own colour lies around it, on both sides; for
`tracking3d.estimation.segmentation.colour_models`."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import kernel


def alike_around(
    labels: NDArray[np.uint8], mask: NDArray[np.bool_], radius: int, size: int
) -> NDArray[np.float32]:
    """``(2, S, S)``: see `tracking3d.estimation.segmentation.colour_models.alike_around`."""
    found = np.empty((2, *labels.shape), np.float32)
    # A label of its own for what lies in the mask; mirrored at the borders as `cv2.blur` does.
    sided = np.where(mask, labels + np.uint8(size), labels).astype(np.int32)
    sided = np.pad(sided, radius, mode="reflect")
    _alike_around(sided, radius, size, found)
    return found


@kernel("void(int32[:,::1], int64, int64, float32[:,:,::1])")
def _alike_around(sided, radius, size, found):
    side = 2 * radius + 1
    least = 0.02 * side * side
    columns = np.zeros((sided.shape[1], 2 * size), np.int32)  # counts in each column within reach of a row
    within = np.zeros(sided.shape[1], np.int64)  # of those, what lies in the mask
    around = np.empty(2 * size, np.int32)
    for row in range(sided.shape[0]):
        for column in range(sided.shape[1]):
            columns[column, sided[row, column]] += 1
            within[column] += sided[row, column] >= size
            if row >= side:
                columns[column, sided[row - side, column]] -= 1
                within[column] -= sided[row - side, column] >= size
        at = row - side + 1
        if at < 0:
            continue
        around[:] = 0
        inside = 0
        for column in range(side - 1):
            inside += within[column]
            for one in range(2 * size):
                around[one] += columns[column, one]
        for column in range(found.shape[2]):
            inside += within[column + side - 1]
            for one in range(2 * size):
                around[one] += columns[column + side - 1, one]
            label = sided[at + radius, column + radius] % size
            found[0, at, column] = around[size + label] / max(inside, least)
            found[1, at, column] = around[label] / max(side * side - inside, least)
            inside -= within[column]
            for one in range(2 * size):
                around[one] -= columns[column, one]
