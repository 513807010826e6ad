"""Warps points of one view into another by surface and poses, and corrects them there by the image.

What the one view shows is warped into the other through the surface, so that it has the right turn and size there; how
far the image lies beside it is the correction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracking3d.points.alignment import NOISE, align
from tracking3d.points.view import REACH, Array, Plane, SurfaceView
from tracking3d.rendering.visibility import NEAR

LEAST_AGREEMENT = 0.7
"""Correlation of a patch with its template from which a correction is trusted."""
_TELLS = 2 * NOISE  # contrast of a template that can be told from something else
_EXPECTED = 3.0
"""Deviation in pixels of the corrections. They are taken for what the images say, and what holds them back is an error
of surface and poses that stays: with 1 pixel a faint texture corrects half of it, and it takes twice as many rounds."""
_FLOOR = 0.05  # deviation in pixels of the best alignments: interpolation, shading
_BEYOND = REACH / 2  # pixels around the surface onto which an image is warped
_LEAST_ROWS = 64  # below, another thread does not pay


@dataclass(frozen=True, eq=False)
class Carried:
    """N points in a further view."""

    predicted: Array  # (N, 2) pixels by surface and poses; NaN if there is no surface
    measured: Array  # (N, 2) pixels, where the image says they are; NaN if it says nothing
    variance: Array  # (N,) squared pixels that the step adds to x and to y; infinite if nothing was measured
    # (N,) correlation with the template, 1 where that is too plain to tell; -1 where there was none
    likeness: Array


class Warps:
    """Views warped into one another.

    Args:
        views: In any order; None if there is none.
        tolerance: How far behind a drawn surface a point may lie and be seen, in object units.
    """

    def __init__(self, views: list[SurfaceView | None], tolerance: float) -> None:
        self.views, self.tolerance = views, tolerance

    def carry(self, source: int, target: int, xy: Array) -> Carried:
        """Carry pixels ``xy`` ``(N, 2)`` of view ``source`` into view ``target``."""
        start, end = self.views[source], self.views[target]
        if start is None or end is None:
            nothing = np.full(xy.shape, np.nan)
            return Carried(nothing, nothing, np.full(len(xy), np.inf), np.full(len(xy), -1.0))
        predicted, seen = end.sees(start.surface(xy), self.tolerance)
        warped, known = _warp(start, end, self.tolerance)
        at = np.where(seen[:, None], predicted, np.nan)
        found = align(warped, known, end.image, at, prior=_EXPECTED)
        good = found.agreement > LEAST_AGREEMENT
        return Carried(
            predicted,
            np.where(good[:, None], predicted + found.shift, np.nan),
            np.where(good, found.variance + _FLOOR**2, np.inf),
            np.where(found.contrast > _TELLS, found.agreement, np.sign(found.contrast) * 2 - 1),
        )


def _warp(source: SurfaceView, target: SurfaceView, tolerance: float) -> tuple[Plane, Plane]:
    """The image of ``source`` as ``target`` would see it, and where it is known."""
    from tracking3d.points.kernels.warping import WarpSource, WarpTarget, warp
    from tracking3d.rendering.kernels.threads import share

    height, width = target.image.shape
    warped, known = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    share(
        warp,
        height,
        _LEAST_ROWS,
        WarpTarget(target.inverse_depth, target.beyond, target.intrinsics, float(_BEYOND)),
        WarpSource(source.intrinsics, source.image, source.mask, source.inverse_depth),
        np.ascontiguousarray(source.T_cam_obj @ np.linalg.inv(target.T_cam_obj)),
        NEAR,
        tolerance,
        warped,
        known,
    )
    return warped, known
