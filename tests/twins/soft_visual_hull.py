"""What cells see of a mask and what rays see of the hulls, by OpenCV and torch."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.estimation.segmentation.soft_visual_hull import _NEAR, _UNKNOWN, CELLS


def carried(
    distance: NDArray[np.float32],
    unknown: NDArray[np.bool_],
    to_pixels: NDArray[np.float64],
    by_depth: float,
    beyond: float,
) -> NDArray[np.int8] | None:
    """See `tracking3d.estimation.segmentation.soft_visual_hull.sample_grid_distances`."""
    z, y, x = np.mgrid[:CELLS, :CELLS, :CELLS].reshape(3, -1)
    u, v, depth = to_pixels @ np.stack([x, y, z, np.ones_like(x)])
    if (depth <= _NEAR).any():
        return None
    u, v = ((one / depth).astype(np.float32).reshape(CELLS, -1) for one in (u, v))
    value, hidden = (
        cv2.remap(plane, u, v, method, borderMode=cv2.BORDER_CONSTANT, borderValue=border).ravel()
        for plane, method, border in (
            (distance, cv2.INTER_LINEAR, beyond),
            (unknown.astype(np.uint8), cv2.INTER_NEAREST, 0),
        )
    )
    value = np.clip(np.rint(value * depth * by_depth), -_UNKNOWN + 1, _UNKNOWN - 1)
    return np.where(hidden > 0, _UNKNOWN, value).astype(np.int8)


def marched(
    hulls: NDArray[np.float32],
    origin: NDArray[np.float32],
    rays: NDArray[np.float32],
    depths: NDArray[np.float32],
    focal: float,
    beyond: float,
) -> NDArray[np.float32]:
    """See `tracking3d.estimation.segmentation.soft_visual_hull.march_rays`."""
    cells = origin + depths[:, None, None, None] * rays
    grid = torch.from_numpy((2 * cells + 1) / np.float32(len(hulls)) - 1)
    signed = torch.from_numpy(hulls[..., : hulls.shape[-1] // 2])
    value = torch.nn.functional.grid_sample(
        signed.permute(3, 0, 1, 2)[None], grid[None], align_corners=False, padding_mode="border"
    )[0].numpy()
    pixels = value / depths[:, None, None] * np.float32(focal)
    missed = (grid.abs().amax(-1) > 1).numpy()
    return np.asarray(np.where(missed, np.float32(beyond), pixels).max(1))
