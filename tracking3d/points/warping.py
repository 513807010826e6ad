"""Warps points of one view into another by surface and poses, and corrects them there by the image.

What the one view shows is warped into the other through the surface, so that it has the right turn and size there; how
far the image lies beside it is the correction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import NEAR
from tracking3d.points.view import REACH
from tracking3d.scene.surface import Drawn
from tracking3d.scene.view import Array, Plane

# Aligns templates with the image around many points at once.
#
# The expected image is already warped into the view, so what is left is a shift. Forwards additive alignment
# with the gradients of the template (Hager and Belhumeur, "Efficient region tracking with parametric models of
# geometry and illumination", 1998): gain and offset of the brightness are free, pixels weigh by a Gaussian window, by
# how much of the template is known there, and by a robust function of what is left. A prior holds the shift at zero,
# so that it goes only where the image says so: along an edge, or where there is no texture, the prediction stands, and
# the covariance says it.

RADIUS, DEVIATION = 6, 3.0
"""Of the window, in pixels: half its side, and the deviation of its Gaussian."""
NOISE = 4.0
"""Deviation of grey values that say the same."""
LEAST_COVER = 0.2
"""Share of the window in which the template has to be known."""
STEPS = 8
_LEAST_SHARED = 64  # points for which another thread pays


@dataclass(frozen=True, eq=False)
class Alignment:
    """What N patches say."""

    shift: Array  # (N, 2) pixels by which the image lies beside the template; 0 if there was nothing to align
    covariance: Array  # (N, 3) of it, xx, xy and yy in squared pixels; infinite there
    agreement: Array  # (N,) correlation of the two patches at the end, -1 there
    contrast: Array  # (N,) deviation of the template's grey values, 0 there

    @property
    def variance(self) -> Array:
        """``(N,)`` mean variance of x and y."""
        mean: Array = (self.covariance[:, 0] + self.covariance[:, 2]) / 2
        return mean


def align(template: Plane, weight: Plane, image: Plane, xy: Array, prior: float = 1.0) -> Alignment:
    """Find what of ``template`` around each point lies where in ``image``.

    Args:
        template: ``(h, w)`` the expected image.
        weight: ``(h, w)`` in [0, 1]: how much of it is known.
        image: ``(h, w)`` the image.
        xy: ``(N, 2)`` pixels of the template; a point that is not finite is not aligned.
        prior: Deviation in pixels of the shifts that are expected.
    """
    from tracking3d.points.kernels import alignment
    from tracking3d.rendering.kernels.compilation import share

    planes = (np.ascontiguousarray(plane, dtype=np.float32) for plane in (template, weight, image))
    points = np.ascontiguousarray(xy, dtype=np.float64)
    settings = alignment.AlignmentSettings(_window(), float(prior), NOISE, LEAST_COVER, STEPS)
    count = len(points)
    found = alignment.AlignmentArrays(np.empty((count, 2)), np.empty((count, 3)), np.empty((count, 2)))
    share(alignment.align, count, _LEAST_SHARED, alignment.AlignedPlanes(*planes), points, settings, found)
    return Alignment(found.shift, found.covariance, found.agreement[:, 0], found.agreement[:, 1])


def _window() -> Array:
    offset = np.arange(-RADIUS, RADIUS + 1.0)
    return np.exp(-(offset[:, None] ** 2 + offset**2) / (2 * DEVIATION**2))


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

    def __init__(self, views: list[Drawn | None], tolerance: float) -> None:
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


def _warp(source: Drawn, target: Drawn, tolerance: float) -> tuple[Plane, Plane]:
    """The image of ``source`` as ``target`` would see it, and where it is known."""
    from tracking3d.points.kernels.warping import WarpSource, WarpTarget, warp
    from tracking3d.rendering.kernels.compilation import share

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


CHAIN_STEPS = (1, 3, 7)
"""How many views back the templates are taken from; the mean of what they say, by their variances, counts."""


@dataclass(frozen=True, eq=False)
class Chain:
    """What the images say about N points in T views, in pixels of each view."""

    measured: Array  # (T, N, 2); NaN if the image says nothing
    # (T, N) squared pixels, that of the steps before included; infinite there, 0 at the start
    variance: Array
    likeness: Array  # (T, N) best likeness to a template, see `Carried`; -1 where there was none


def follow_chain(
    warps: Warps, start: NDArray[np.integer], xy: Array, steps: Sequence[int] = CHAIN_STEPS
) -> Chain:
    """Follow pixels ``xy`` ``(N, 2)`` of views ``start`` ``(N,)`` from view to view.

    A point that the views just before do not hold, since it was hidden there, is looked for again with the template of
    its first view.
    """
    views, count = len(warps.views), len(xy)
    chain = Chain(
        np.full((views, count, 2), np.nan), np.full((views, count), np.inf), np.full((views, count), -1.0)
    )
    rows = np.arange(count)
    chain.measured[start, rows], chain.variance[start, rows], chain.likeness[start, rows] = xy, 0.0, 1.0
    for direction, path in ((1, range(views)), (-1, range(views - 1, -1, -1))):
        for target in path:
            behind = (target - start) * direction  # how many views ago each point began
            if warps.views[target] is None or not (behind > 0).any():
                continue
            before = [
                (target - direction * step, behind >= step)
                for step in steps
                if 0 <= target - direction * step < views
            ]
            extend(chain, warps, target, before)
            missing = ~np.isfinite(chain.variance[target]) & (behind > 0)
            extend(
                chain,
                warps,
                target,
                [
                    (first, missing & (start == first))
                    for first in np.unique(start[missing]).tolist()
                    if abs(target - first) not in steps
                ],
            )
    return chain


def extend(chain: Chain, warps: Warps, target: int, sources: Sequence[tuple[int, NDArray[np.bool_]]]) -> None:
    """Write what the templates of some views say about one more view.

    Args:
        chain: Is written to.
        warps: The views.
        target: Index of the view.
        sources: Those of the templates, and ``(N,)`` which points each is asked for; points that it does not hold are
            left as they are.
    """
    count = chain.variance.shape[1]
    total, weights = np.zeros((count, 2)), np.zeros(count)
    for source, of in sources:
        chosen = np.flatnonzero(of & np.isfinite(chain.variance[source]))
        if not len(chosen):
            continue
        carried = warps.carry(source, target, chain.measured[source, chosen])
        variance = carried.variance + chain.variance[source, chosen]
        weight = np.where(np.isfinite(variance), 1 / variance, 0)
        total[chosen] += weight[:, None] * np.nan_to_num(carried.measured)
        weights[chosen] += weight
        best = np.maximum(chain.likeness[target, chosen], carried.likeness)
        chain.likeness[target, chosen] = best
    found = weights > 0
    chain.measured[target, found] = total[found] / weights[found, None]
    chain.variance[target, found] = 1 / weights[found]
