"""Where the motions of object and background lead, by whole arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.evidence.motion import Matrix, _carried, _projected
from tracking3d.evidence.scene import Plane


def parted_ways(
    inverse_depth: Plane,
    of_surface: Matrix,
    of_background: Matrix,
    image_size: tuple[int, int],
    apart: tuple[float, float],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """See `tracking3d.evidence.motion.parted_ways`."""
    near = inverse_depth[..., None]
    moved = _carried(len(inverse_depth), of_surface[:, :3]) + near * of_surface[:, 3]
    beyond = _carried(len(inverse_depth), of_background)
    ways = np.stack([_projected(np.where(near > 0, moved, np.nan)), _projected(beyond)])
    limit = np.array([image_size[1] - 1, image_size[0] - 1])
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((ways > 0) & (ways < limit)).all((0, -1)))
    ways = np.where(inside[..., None], ways, 0).astype(np.float32)
    parted = np.linalg.norm(ways[0] - ways[1], axis=-1)
    return ways, np.clip((parted - apart[0]) / (apart[1] - apart[0]), 0, 1) * inside
