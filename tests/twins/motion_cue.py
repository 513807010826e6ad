"""Where the motions of object and background lead, by whole arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tracking3d.estimation.segmentation.motion_cue import Matrix, _carry_through, _project
from tracking3d.scene.view import Plane


def parted_ways(
    inverse_depth: Plane,
    of_surface: Matrix,
    of_background: Matrix,
    image_size: tuple[int, int],
    apart: tuple[float, float],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """See `tracking3d.estimation.segmentation.motion_cue.motion_parallax`."""
    near = inverse_depth[..., None]
    moved = _carry_through(len(inverse_depth), of_surface[:, :3]) + near * of_surface[:, 3]
    beyond = _carry_through(len(inverse_depth), of_background)
    ways = np.stack([_project(np.where(near > 0, moved, np.nan)), _project(beyond)])
    limit = np.array([image_size[1] - 1, image_size[0] - 1])
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((ways > 0) & (ways < limit)).all((0, -1)))
    ways = np.where(inside[..., None], ways, 0).astype(np.float32)
    parted = np.linalg.norm(ways[0] - ways[1], axis=-1)
    return ways, np.clip((parted - apart[0]) / (apart[1] - apart[0]), 0, 1) * inside
