"""One view as another one would see it, by OpenCV."""

from __future__ import annotations

import cv2
import numpy as np

from tracking3d.points.warping import _BEYOND
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import Plane


def warped(source: Drawn, target: Drawn, tolerance: float) -> tuple[Plane, Plane]:
    """See `tracking3d.points.warping._warp`."""
    near = (target.beyond < _BEYOND) & (target.inverse_depth > 0)
    rows, columns = np.nonzero(near)
    points = target.back_project(np.stack([columns, rows], 1).astype(float), target.inverse_depth[near])
    xy, depth = source.project(points)
    maps = np.full((2, *near.shape), -1e4, np.float32)
    maps[:, near] = np.nan_to_num(xy.T, nan=-1e4)
    behind = np.full(near.shape, np.inf, np.float32)
    behind[near] = depth
    image, mask, inverse = (
        cv2.remap(plane, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        for plane in (source.image, source.mask, source.inverse_depth)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = (inverse > 0) & (behind < 1 / inverse + tolerance)
    return image, np.where(seen, mask, 0).astype(np.float32)
