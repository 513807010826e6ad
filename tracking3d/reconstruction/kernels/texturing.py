"""Kernel of `tracking3d.reconstruction.texturing`: one view's say about the texels that it shows, in one pass."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import kernel


def add_view(
    total: NDArray[np.float32],
    weight: NDArray[np.float32],
    seen: tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]],
    gain: NDArray[np.float32],
    expected: NDArray[np.float32],
    sharpness: float,
    voted_down: float,
    steepness: int,
) -> None:
    """See `tracking3d.reconstruction.texturing.add_view`."""
    _add_view(total, weight, *seen, gain, expected, sharpness, voted_down, steepness)


@kernel(
    "void(float32[:,::1], float32[::1], int64[::1], float32[:,:], float32[::1], float32[::1], float32[:,::1],"
    " float32, float32, int64)"
)
def _add_view(total, weight, texel, colours, seen, gain, expected, sharpness, voted_down, steepness):
    one = np.float32(1)
    for n in range(len(texel)):
        at = texel[n]
        r, g, b = gain[0] * colours[0, n], gain[1] * colours[1, n], gain[2] * colours[2, n]
        x, y, z = r - expected[at, 0], g - expected[at, 1], b - expected[at, 2]
        apart = (x * x + y * y + z * z) / (voted_down * voted_down)
        say = one / (one + apart)
        for _ in range(steepness):
            say *= seen[n] * sharpness
        total[at, 0] += say * r
        total[at, 1] += say * g
        total[at, 2] += say * b
        weight[at] += say
