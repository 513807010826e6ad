"""A soft visual hull from the masks of all frames.

A point of space is outside the object where enough views put it there. In each view, its distance from the mask's
outline is taken into space by the point's depth; of these the hull has one at a low rank, so that a few wrong masks
carve nothing, and what a mask took in though others did not is taken out.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tracking3d.scene.surface import Drawn
from tracking3d.trackers.outline import inside_distance

CELLS = 64
RANKS = (0.04, 0.15)
"""Shares of the views that may be wrong; a hull for each."""
_MARGIN = 0.15  # of the grid beside the surface, relative to its extent
_STEPS = 48
_LEAST_VIEWS = 4
_NEAR = 1e-3  # depth of a cell
_UNKNOWN = 127  # larger than any stored distance
_MOST_UNKNOWN = 0.7  # of the views


class SoftVisualHull:
    """Collects views, then draws their hull in any frame.

    Args:
        vertices: ``(V, 3)`` of the object: where the hull can be.
    """

    def __init__(self, vertices: NDArray[np.float64]) -> None:
        low, high = vertices.min(0), vertices.max(0)
        middle, half = (low + high) / 2, (0.5 + _MARGIN) * float((high - low).max())
        self._low, self._side = middle - half, 2 * half
        self._unit = self._side / 400  # a step of the stored distances
        self._views: list[NDArray[np.int8]] = []
        self._hulls: NDArray[np.float32] | None = None

    def see(self, scene: Drawn) -> None:
        """Add a frame whose pose and mask are trusted."""
        # Beyond the window nothing is the object, beyond the frame nothing is known.
        size = scene.window.size
        distance = np.clip(inside_distance(scene.mask), -size, size)
        P = scene.K @ scene.T_cam_obj[:3]
        step = self._side / CELLS
        to_pixels = np.column_stack([step * P[:, :3], P[:, :3] @ (self._low + step / 2) + P[:, 3]])
        by_depth = 1 / (float(scene.K[0, 0]) * self._unit)
        values = sample_grid_distances(distance, ~scene.in_frame, to_pixels, by_depth, -size)
        if values is not None:
            self._views.append(values)

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
        self._hulls = sharpen_peaks(hull.reshape(len(RANKS), CELLS, CELLS, CELLS))
        self._views = []

    def drawn(self, scene: Drawn) -> NDArray[np.float32] | None:
        """``(R, S, S)`` pixels within (positive) or from the hulls in a frame; None if they are not known."""
        if self._hulls is None or not np.isfinite(scene.T_cam_obj).all():
            return None
        size = scene.window.size
        coarse = max(size // 2, 8)
        step = size / coarse
        centres = np.arange(coarse) * step + (step - 1) / 2
        v, u = centres[:, None, None], centres[:, None]
        R, t = scene.T_cam_obj[:3, :3], scene.T_cam_obj[:3, 3]
        to_cells = CELLS / self._side * R.T
        by_u, by_v, first = (to_cells @ np.linalg.inv(scene.K)).T
        rays = u * by_u + v * by_v + first
        origin = -to_cells @ t - self._low * CELLS / self._side - 0.5
        middle = float((R @ (self._low + self._side / 2) + t)[2])
        radius = 0.75 * self._side
        depths = np.linspace(max(middle - radius, 1e-2), middle + radius, _STEPS)
        # The deepest within come first, so that most of the others need no look.
        depths = depths[np.argsort(np.abs(depths - middle), kind="stable")]
        nearest = march_rays(
            self._hulls,
            origin.astype(np.float32),
            rays.astype(np.float32),
            depths.astype(np.float32),
            float(scene.K[0, 0]),
            -float(size),
        )
        return np.stack([cv2.resize(one, (size, size), interpolation=cv2.INTER_LINEAR) for one in nearest])


def sample_grid_distances(
    distance: NDArray[np.float32],
    unknown: NDArray[np.bool_],
    to_pixels: NDArray[np.float64],
    by_depth: float,
    beyond: float,
) -> NDArray[np.int8] | None:
    """``(C * C * C,)`` distances that the cells of the grid have in a view, in whole units, `_UNKNOWN` where unknown.

    Args:
        distance: ``(S, S)`` pixels to the outline.
        unknown: ``(S, S)`` what lies beyond the frame.
        to_pixels: ``(3, 4)`` from ``x, y, z, 1`` in cells to homogeneous pixels, the third of them the depth.
        by_depth: Units that a pixel has at a depth of 1.
        beyond: The distance beyond the window.

    Returns:
        None if a cell is not in front of the camera.
    """
    from tracking3d.estimation.segmentation.kernels import soft_visual_hull

    return soft_visual_hull.sample_grid_distances(
        distance, unknown, to_pixels, by_depth, beyond, _NEAR, CELLS, _UNKNOWN
    )


def sharpen_peaks(hulls: NDArray[np.float32]) -> NDArray[np.float32]:
    """``(C, C, C, 2 R)``: signed distances ``(R, C, C, C)`` by z, y and x, then the largest of a cell's 8 corners."""
    peaks = hulls
    for axis in (1, 2, 3):
        after = np.minimum(np.arange(CELLS) + 1, CELLS - 1)
        peaks = np.maximum(peaks, peaks.take(after, axis))
    return np.ascontiguousarray(np.concatenate([hulls, peaks]).transpose(1, 2, 3, 0))


def march_rays(
    hulls: NDArray[np.float32],
    origin: NDArray[np.float32],
    rays: NDArray[np.float32],
    depths: NDArray[np.float32],
    focal: float,
    beyond: float,
) -> NDArray[np.float32]:
    """``(R, S, S)`` pixels within or from hulls, where each ray comes nearest to being within.

    Args:
        hulls: ``(C, C, C, 2 R)`` from `sharpen_peaks`.
        origin: ``(3,)`` of the camera in cells; the middle of the first cell is at 0.
        rays: ``(S, S, 3)`` in cells, for a depth of 1.
        depths: ``(D,)`` at which each ray is asked.
        focal: Pixels that a distance of 1 has at a depth of 1.
        beyond: What rays get that miss the grid.
    """
    from tracking3d.estimation.segmentation.kernels import soft_visual_hull

    return soft_visual_hull.march_rays(hulls, origin, rays, depths, focal, beyond)
