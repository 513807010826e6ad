"""Points of one view carried into another one by surface and poses, and corrected there by the image.

What the one view shows is warped into the other through the surface, so that it has the right turn and size there; how
far the image lies beside it is the correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from tracking3d.points.alignment import NOISE, align
from tracking3d.points.view import REACH, Array, Plane, View
from tracking3d.rendering.backend import use_numba
from tracking3d.rendering.visibility import NEAR

LEAST_AGREEMENT = 0.7
"""Correlation of a patch with its template from which a correction is believed."""
_TELLS = 2 * NOISE  # contrast of a template that can be told from something else
_EXPECTED = 3.0
"""Deviation in pixels of the corrections. They are taken for what the images say, and what holds them back is an error
of surface and poses that stays: with 1 pixel a faint texture corrects half of it, and it takes twice as many rounds."""
_FLOOR = 0.05  # deviation in pixels of the best alignments: interpolation, shading
_BEYOND = REACH / 2  # pixels around the surface onto which an image is warped
_LEAST_ROWS = 64  # below, another thread does not pay


@dataclass(frozen=True, eq=False)
class Carried:
    """N points in a further view.

    Attributes:
        predicted: ``(N, 2)`` pixels by surface and poses; NaN where there is no surface.
        measured: ``(N, 2)`` pixels, where the image says they are; NaN where it says nothing.
        variance: ``(N,)`` squared pixels that the step adds to x and to y; infinite where nothing was measured.
        likeness: ``(N,)`` correlation with the template, 1 where that is too plain to tell; -1 where there was none.
    """

    predicted: Array
    measured: Array
    variance: Array
    likeness: Array


class Warps:
    """Views warped into one another.

    Args:
        views: In any order; None where there is none.
        tolerance: How far behind a drawn surface a point may lie and be seen, in object units.
    """

    def __init__(self, views: list[View | None], tolerance: float) -> None:
        self.views, self.tolerance = views, tolerance
        self._pixels: tuple[int, NDArray[np.bool_], Array] | None = (
            None  # of the view that was last asked for
        )

    def carry(self, source: int, target: int, xy: Array, backend: str = "auto") -> Carried:
        """Carry pixels ``xy`` ``(N, 2)`` of view ``source`` into view ``target``."""
        start, end = self.views[source], self.views[target]
        if start is None or end is None:
            nothing = np.full(xy.shape, np.nan)
            return Carried(nothing, nothing, np.full(len(xy), np.inf), np.full(len(xy), -1.0))
        predicted, seen = end.sees(start.surface(xy), self.tolerance)
        warped, known = self._warp(source, target, backend)
        at = np.where(seen[:, None], predicted, np.nan)
        found = align(warped, known, end.image, at, prior=_EXPECTED, backend=backend)
        good = found.agreement > LEAST_AGREEMENT
        return Carried(
            predicted,
            np.where(good[:, None], predicted + found.shift, np.nan),
            np.where(good, found.variance + _FLOOR**2, np.inf),
            np.where(found.contrast > _TELLS, found.agreement, np.sign(found.contrast) * 2 - 1),
        )

    def _warp(self, source: int, target: int, backend: str) -> tuple[Plane, Plane]:
        """The image of ``source`` as ``target`` would see it, and where it is known."""
        start, end = self.views[source], self.views[target]
        assert start is not None and end is not None
        if use_numba(backend, torch.empty(0, dtype=torch.float32)):
            return _warp(start, end, self.tolerance)
        near, points = self._surface_pixels(target)
        xy, depth = start.project(points)
        maps = np.full((2, *near.shape), -1e4, np.float32)
        maps[:, near] = np.nan_to_num(xy.T, nan=-1e4)
        behind = np.full(near.shape, np.inf, np.float32)
        behind[near] = depth
        image, mask, inverse = (
            cv2.remap(plane, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            for plane in (start.image, start.mask, start.inverse_depth)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = (inverse > 0) & (behind < 1 / inverse + self.tolerance)
        return image, np.where(seen, mask, 0).astype(np.float32)

    def _surface_pixels(self, index: int) -> tuple[NDArray[np.bool_], Array]:
        """``(h, w)`` pixels on or near the surface of a view, and ``(P, 3)`` the points under them."""
        if self._pixels is None or self._pixels[0] != index:
            view = self.views[index]
            assert view is not None
            near = (view.beyond < _BEYOND) & (view.inverse_depth > 0)
            rows, columns = np.nonzero(near)
            points = view.back_project(np.stack([columns, rows], 1).astype(float), view.inverse_depth[near])
            self._pixels = index, near, points
        return self._pixels[1:]


def _warp(source: View, target: View, tolerance: float) -> tuple[Plane, Plane]:
    """The same by the kernel, rows shared among threads."""
    from tracking3d.points.kernels.warping import warp
    from tracking3d.rendering.kernels.threads import share

    height, width = target.image.shape
    warped, known = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    share(
        warp, height, _LEAST_ROWS,
        target.inverse_depth, target.beyond, _BEYOND, target.intrinsics,
        np.ascontiguousarray(source.T_cam_obj @ np.linalg.inv(target.T_cam_obj)),
        source.intrinsics, source.image, source.mask, source.inverse_depth, NEAR, tolerance,
        warped, known,
    )  # fmt: skip
    return warped, known
