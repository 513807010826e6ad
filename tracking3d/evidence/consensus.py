"""What the masks of all frames say together: a soft visual hull.

A point of space is outside the object where enough views put it there. In each view, its distance from the mask's
outline is taken into space by the point's depth; of these the hull has one at a low rank, so that a few wrong masks
carve nothing, and what a mask took in though others did not is taken out.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.evidence.scene import Scene
from tracking3d.trackers.outline import signed_distance

CELLS = 64
RANKS = (0.04, 0.15)
"""Shares of the views that may be wrong; a hull for each."""
_MARGIN = 0.15  # of the grid beside the surface, relative to its extent
_STEPS = 48
_LEAST_VIEWS = 4
_UNKNOWN = 127  # larger than any stored distance
_MOST_UNKNOWN = 0.7  # of the views


class Consensus:
    """Collects views, then draws their hull in any frame.

    Args:
        vertices: ``(V, 3)`` of the object: where the hull can be.
    """

    def __init__(self, vertices: NDArray[np.float64]) -> None:
        low, high = vertices.min(0), vertices.max(0)
        middle, half = (low + high) / 2, (0.5 + _MARGIN) * float((high - low).max())
        self._low, self._side = middle - half, 2 * half
        steps = (np.arange(CELLS, dtype=np.float32) + 0.5) / CELLS * self._side
        z, y, x = np.meshgrid(steps, steps, steps, indexing="ij")
        self._points = (np.stack([x, y, z], -1).reshape(-1, 3) + self._low).astype(np.float32)
        self._unit = self._side / 400  # a step of the stored distances
        self._views: list[NDArray[np.int8]] = []
        self._hull: torch.Tensor | None = None

    def see(self, scene: Scene) -> None:
        """Add a frame whose pose and mask are believed."""
        P = (scene.K @ scene.T_cam_obj[:3]).astype(np.float32)
        seen = self._points @ P[:, :3].T + P[:, 3]
        depth = seen[:, 2]
        if (depth <= 1e-3).any():
            return
        x, y = ((seen[:, i] / depth).reshape(CELLS, -1) for i in (0, 1))
        size = scene.window.size
        distance = np.clip(signed_distance(scene.answer), -size, size)
        # Beyond the window nothing is the object, beyond the frame nothing is known.
        far = np.float32(-size)
        value = cv2.remap(
            distance, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=float(far)
        ).ravel()
        unknown = (
            cv2.remap(
                (~scene.valid).astype(np.float32), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
            ).ravel()
            > 0
        )
        value = value * depth / np.float32(scene.K[0, 0]) / np.float32(self._unit)
        value = np.clip(np.rint(value), -_UNKNOWN + 1, _UNKNOWN - 1)
        value[unknown] = _UNKNOWN
        self._views.append(value.astype(np.int8))

    def settle(self) -> None:
        """All views are there."""
        if len(self._views) < _LEAST_VIEWS:
            return
        count = len(self._views)
        values = np.stack(self._views, 1)
        places = [min(max(round(share * count), 1), count - 1) for share in RANKS]
        values.partition(places, axis=1)
        hull = values[:, places].T.astype(np.float32) * self._unit
        # Where few views can see nothing is known, and the hull ends.
        hull[:, np.count_nonzero(values == _UNKNOWN, axis=1) > _MOST_UNKNOWN * count] = -self._side
        self._hull = torch.from_numpy(hull).reshape(1, len(RANKS), CELLS, CELLS, CELLS)
        self._views = []

    def drawn(self, scene: Scene) -> NDArray[np.float32] | None:
        """``(R, S, S)`` pixels within (positive) or from the hulls in a frame; None where they are not known."""
        if self._hull is None or not np.isfinite(scene.T_cam_obj).all():
            return None
        size = scene.window.size
        coarse = max(size // 2, 8)
        step = size / coarse
        centres = torch.arange(coarse, dtype=torch.float32) * step + (step - 1) / 2
        v, u = torch.meshgrid(centres, centres, indexing="ij")
        K_inv = torch.tensor(np.linalg.inv(scene.K), dtype=torch.float32)
        T = scene.T_cam_obj
        R, t = T[:3, :3], T[:3, 3]
        rays = torch.stack([u, v, torch.ones_like(u)], -1) @ K_inv.T @ torch.tensor(R, dtype=torch.float32)
        origin = torch.tensor(-R.T @ t, dtype=torch.float32)
        middle = R @ (self._low + self._side / 2) + t
        radius = 0.75 * self._side
        depths = torch.linspace(max(middle[2] - radius, 1e-2), middle[2] + radius, _STEPS)
        points = origin + depths[:, None, None, None] * rays
        low = torch.tensor(self._low, dtype=torch.float32)
        grid = (points - low) / self._side * 2 - 1
        beyond = (grid.abs().amax(-1) > 1)[None]
        value = torch.nn.functional.grid_sample(
            self._hull, grid[None], align_corners=False, padding_mode="border"
        )[0]
        pixels = value / depths[:, None, None] * float(scene.K[0, 0])
        nearest = pixels.masked_fill(beyond, -float(size)).amax(1).numpy()
        return np.stack([cv2.resize(one, (size, size), interpolation=cv2.INTER_LINEAR) for one in nearest])
