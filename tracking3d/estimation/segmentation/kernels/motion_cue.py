"""Kernel of `tracking3d.estimation.segmentation.motion_cue`: where both motions lead, pixel by pixel in one pass."""
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.rendering.kernels.compilation import kernel


def motion_parallax(
    inverse_depth: NDArray[np.float32],
    of_surface: NDArray[np.float64],
    of_background: NDArray[np.float64],
    image_size: tuple[int, int],
    apart: tuple[float, float],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """See `tracking3d.estimation.segmentation.motion_cue._motion_parallax`, with matrices from window pixels instead
    of the scene.

    Args:
        inverse_depth: ``(S, S)``.
        of_surface: ``(3, 4)`` from ``u, v, 1, 1 / depth`` to homogeneous pixels of the other frame.
        of_background: ``(3, 3)`` from ``u, v, 1`` to those.
        image_size: ``(H, W)`` of the other frame.
        apart: Pixels of distance from which on, and in full, the motions can be told.
    """
    ways = np.zeros((2, *inverse_depth.shape, 2), np.float32)
    share = np.zeros(inverse_depth.shape, np.float32)
    _motion_parallax(inverse_depth, of_surface, of_background, *image_size, *apart, ways, share)
    return ways, share


@kernel(
    "void(float32[:,::1], float64[:,::1], float64[:,::1], int64, int64, float64, float64,"
    " float32[:,:,:,::1], float32[:,::1])"
)
def _motion_parallax(inverse_depth, P, H, height, width, least, most, ways, share):
    for v in range(inverse_depth.shape[0]):
        for u in range(inverse_depth.shape[1]):
            near = inverse_depth[v, u]
            z = P[2, 0] * u + P[2, 1] * v + P[2, 2] + P[2, 3] * near
            w = H[2, 0] * u + H[2, 1] * v + H[2, 2]
            if not (near > 0 and z > 0 and w > 0):
                continue
            x = (P[0, 0] * u + P[0, 1] * v + P[0, 2] + P[0, 3] * near) / z
            y = (P[1, 0] * u + P[1, 1] * v + P[1, 2] + P[1, 3] * near) / z
            a, b = (H[0, 0] * u + H[0, 1] * v + H[0, 2]) / w, (H[1, 0] * u + H[1, 1] * v + H[1, 2]) / w
            if min(x, y, a, b) > 0 and max(x, a) < width - 1 and max(y, b) < height - 1:
                ways[0, v, u, 0], ways[0, v, u, 1], ways[1, v, u, 0], ways[1, v, u, 1] = x, y, a, b
                parted = np.sqrt((x - a) ** 2 + (y - b) ** 2)
                share[v, u] = min(max((parted - least) / (most - least), 0.0), 1.0)
