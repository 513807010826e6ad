"""Robust bundle adjustment of points and poses by measurements in the images.

Wrong tracks do not count for robust weights, and a prior holds the points at the surface that the run has found: they
go only where the images say so, and size and place of the whole stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tracking3d.geometry.camera import LENS_EXCLUDED, LENS_KNOWN
from tracking3d.points.bundle_adjustment import Structure, Tracks, adjust
from tracking3d.points.bundle_adjustment.adjustment import Reversal, reversal_of
from tracking3d.scene.view import Array

TURNS = 12
_CONVERGED = 3e-4
"""Gain of a step that ends a bundle: what further ones turn poses by is some hundredths of a degree."""
LEAST_MEASURED = 8
"""Points that a view has to hold for its pose to be moved by them."""
_BETTER = 0.97
"""Share of the cost up to which the reversed explanation is the better one. Of 72 runs of the suites ``fresh`` of seeds
501, 602 and 9303 it was lower in five, by .62 to .98, all of which were turned the wrong way."""
_HOPELESS = 1.5
"""Share of it above which it is not looked into further. On box_in_hand and car_roundabout it is 2 to 7."""
_GLIMPSE = 4
"""Steps after which that shows: on those two clips the cost is then within a tenth of where it ends."""
_OUTLIER = 3.0  # deviations at which a measurement has a quarter of its weight
_AHEAD = 1e-3  # depth from which on points have an image
_LEAST_SHARED = 64  # points for which another thread pays
_LENS = 0.3  # deviation of the logarithm of a focal length that is not given


@dataclass(frozen=True, eq=False)
class BundleResult:
    """Points and poses that agree with the measurements."""

    points: Array  # (N, 3) in object coordinates
    T_cam_obj: Array  # (T, 4, 4)
    weight: Array  # (T, N) that the measurements had in the end: 0 if there is none
    focal_factor: float  # by which all focal lengths are to be multiplied
    cost: float  # mean robust loss of the measurements, by weight
    agreeing: NDArray[np.bool_]  # (T, N) bool, the measurements that the points and poses explain
    # standard deviation of the logarithm of the focal length; None if it was not estimated
    focal_deviation: float | None = None


def intersect(
    points: Array,
    intrinsics: Array,
    T_cam_obj: Array,
    measured: Array,
    deviation: Array,
    held: float,
    turns: int = TURNS,
) -> tuple[Array, Array]:
    """Move points to where the views measure them.

    Args:
        points: ``(N, 3)`` in object coordinates.
        intrinsics: ``(T, 4)`` fx, fy, cx, cy of every view.
        T_cam_obj: ``(T, 4, 4)``.
        measured: ``(T, N, 2)`` pixels; NaN if there is none.
        deviation: ``(T, N)`` of them in pixels; infinite if there is none.
        held: Deviation of the points' movement, in object units.
        turns: Steps.

    Returns:
        The points, and the weights ``(T, N)`` that the measurements had in the end: 0 if there is none.
    """
    from tracking3d.points.kernels.intersection import intersect as compiled
    from tracking3d.rendering.kernels.compilation import share

    known = np.isfinite(deviation) & np.isfinite(measured).all(2)
    certain = np.where(known, 1 / np.where(known, deviation, 1.0) ** 2, 0.0)
    moved, weight = np.array(points, dtype=np.float64, order="C"), np.zeros((len(points), len(T_cam_obj)))
    share(
        compiled, len(points), _LEAST_SHARED,
        moved, *(np.ascontiguousarray(one, np.float64) for one in (intrinsics, T_cam_obj)),
        np.ascontiguousarray(measured.transpose(1, 0, 2)), np.ascontiguousarray(certain.T),
        held, _OUTLIER, _AHEAD, turns, weight,
    )  # fmt: skip
    return moved, weight.T


def bundle(
    points: Array,
    intrinsics: Array,
    T_cam_obj: Array,
    measured: Array,
    deviation: Array,
    held: float,
    begun: BundleResult | None = None,
    turns: int = TURNS,
) -> BundleResult:
    """Move points and poses so that they agree with the measurements.

    Views that hold too few measurements keep their poses.

    Args:
        points, intrinsics, T_cam_obj, measured, deviation, held: See `intersect`.
        begun: What this made of the same, to go on from, now with another lens if the views tell one, see `LENS_KNOWN`,
            and it has proof: all focal lengths may change by one factor. Errors along a track hang together, so that a
            whole track counts as much as one independent measurement, and has to pay for how far the lens changes.
        turns: The most steps that are tried.
    """
    known = np.isfinite(deviation) & np.isfinite(measured).all(2)
    known &= (known.sum(1) >= LEAST_MEASURED)[:, None]
    if not known.any():
        return BundleResult(points, T_cam_obj.copy(), np.zeros(deviation.shape), 1.0, math.inf, known)
    # One camera for all views: its pixels are those of the middle one.
    focal = float(np.median(intrinsics[:, :2]))
    pixels = focal * (measured - intrinsics[:, None, 2:]) / intrinsics[:, None, :2]
    spread = np.where(known, deviation * (focal / intrinsics[:, :2].mean(1))[:, None], np.inf)
    outlier = _OUTLIER * float(np.median(spread[known]))
    tracks = Tracks(pixels, known, np.where(known, (outlier / _OUTLIER / spread) ** 2, 0.0))
    solved = partial(
        adjust,
        tracks,
        np.diag([focal, focal, 1.0]),
        fixed=0,
        scale=outlier,
        iterations=turns,
        converged=_CONVERGED,
        point_prior=points,
        point_prior_weight=(_OUTLIER * held) ** -2,
    )
    if begun is None:
        found = solved(Structure(T_cam_obj[:, :3, :3].copy(), T_cam_obj[:, :3, 3].copy(), points.copy()))
        deviation_of_lens = None
    else:
        T = begun.T_cam_obj
        found = solved(Structure(T[:, :3, :3], T[:, :3, 3], begun.points), free_focal=True)
        tracked = known.any(1).sum()
        gain = _OUTLIER**2 * (begun.cost - found.cost) * tracks.weights().sum() / tracked
        # The loss is half of minus twice the logarithm of the likelihood, in units of squared outliers.
        information = 0.5 * _OUTLIER**2 * found.focal_curvature / tracked
        deviation_of_lens = 1 / math.sqrt(information + _LENS**-2)
        change = abs(math.log(found.focal_factor))
        told = deviation_of_lens <= LENS_KNOWN or change > LENS_EXCLUDED * deviation_of_lens
        if not told or not gain > (change / _LENS) ** 2:
            return replace(begun, focal_deviation=deviation_of_lens)
    T = T_cam_obj.copy()
    T[:, :3, :3], T[:, :3, 3] = found.R, found.t
    far = np.where(known, found.residual, 0.0) / (_OUTLIER * np.where(known, spread, 1.0))
    weight = np.where(known, 1 / (1 + far**2) ** 2 / spread**2, 0.0)
    agreeing = known & (far < 1)
    return BundleResult(found.points, T, weight, found.focal_factor, found.cost, agreeing, deviation_of_lens)


@dataclass(frozen=True, eq=False)
class ReversedSolution:
    """What points and poses become with depth reversed."""

    reversal: Reversal  # that of points and poses
    found: BundleResult  # what they become by it
    ratio: float  # its cost, compared with that of the way round at hand

    @property
    def is_better(self) -> bool:
        """Whether the reversed explanation is accepted."""
        return self.ratio < _BETTER

    @property
    def is_hopeless(self) -> bool:
        """Whether the reversal need not be tried again."""
        return self.ratio > _HOPELESS


def solve_reversed(
    points: Array, T_cam_obj: Array, solved: Callable[..., BundleResult], as_it_is: BundleResult
) -> ReversedSolution:
    """What becomes of points and poses the other way round.

    Args:
        points: ``(N, 3)`` in object coordinates, one at least.
        T_cam_obj: ``(T, 4, 4)``.
        solved: Bundles ``points`` and ``T_cam_obj`` through the lens at hand, see `bundle`.
        as_it_is: What it makes of these.
    """
    cost = max(as_it_is.cost, 1e-12)
    reversal = reversal_of(points, T_cam_obj[len(T_cam_obj) // 2])
    found = solved(reversal.points(points), T_cam_obj=reversal.poses(T_cam_obj), turns=_GLIMPSE)
    other = ReversedSolution(reversal, found, found.cost / cost)
    if other.is_hopeless:
        return other
    for _ in range(2):
        found = solved(found.points, T_cam_obj=found.T_cam_obj)
    return ReversedSolution(reversal, found, found.cost / cost)
