"""Aligns templates with the image around many points at once.

The expected image is already warped into the view, so what is left is a shift. Forwards additive alignment
with the gradients of the template (Hager and Belhumeur, "Efficient region tracking with parametric models of
geometry and illumination", 1998): gain and offset of the brightness are free, pixels weigh by a Gaussian window, by
how much of the template is known there, and by a robust function of what is left. A prior holds the shift at zero,
so that it goes only where the image says so: along an edge, or where there is no texture, the prediction stands, and
the covariance says it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tracking3d.points.view import Array, Plane

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
    from tracking3d.rendering.kernels.threads import share

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
