"""Tracks the points of one view in all views: predicted by surface and poses, corrected by the images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.points.landmark_adjustment import LandmarkScene
from tracking3d.points.robust_bundle import intersect
from tracking3d.points.warping import Chain, follow_chain
from tracking3d.scene.surface import Drawn, sample
from tracking3d.scene.view import Array

RIM = 3.0
"""Pixels beside the drawn surface that are still on its rim."""
_HELD = 0.06  # deviation in radii of a point's way off the surface
_DEVIATION = 0.03  # pixels that the best measurement is off
_BELIEVED = 0.25  # share of its full weight from which a measurement counts
_LEAST_DEVIATION = 0.1  # pixels that a prediction is off at best
_SEEN = 0.02  # radii behind the drawn surface at which a point is seen
_UNLIKE = 0.2  # likeness below which something else is in front


@dataclass(frozen=True, eq=False)
class Followed:
    """N points in T views, in pixels of the frames."""

    positions: Array  # (T, N, 2); NaN for points in the background, and where there is no view
    visible: NDArray[np.bool_]  # (T, N) bool
    # (T, N) pixels within twice which a position is right in some 19 of 20 cases; NaN if there is no position
    uncertainty: Array
    measured: NDArray[np.bool_]  # (T, N) bool: whether the image had a say
    points: Array  # (N, 3) in object coordinates; NaN for points in the background
    # (T, N, F) what the uncertainty is estimated from, see `tracking3d.points.follow.error_features`;
    # NaN if there is no position
    features: Array


def follow_points(scene: LandmarkScene, start: int, xy: Array) -> Followed:
    """Follow pixels of one view through all of them.

    Args:
        scene: The surface in its views; see `tracking3d.points.landmark_adjustment.refine_scene`.
        start: Index of the view that the pixels are in.
        xy: ``(N, 2)`` pixels of its frame; those up to a few pixels beside the surface count as on its rim.
    """
    count, whole = len(xy), len(scene.views)
    found = Followed(
        np.full((whole, count, 2), np.nan),
        np.zeros((whole, count), bool),
        np.full((whole, count), np.nan),
        np.zeros((whole, count), bool),
        np.full((count, 3), np.nan),
        np.full((whole, count, FEATURES), np.nan),
    )
    view = scene.views[start]
    if view is None:
        return found
    pixels = view.to_window(xy)
    points = view.surface(pixels)
    on = np.flatnonzero(np.isfinite(points).all(1) & (sample(view.beyond, pixels) < RIM))
    if not len(on):
        return found
    chain = follow_chain(scene.warps(), np.full(len(on), start), pixels[on])
    there = [index for index, one in enumerate(scene.views) if one is not None]
    views = [one for one in scene.views if one is not None]
    seen = combine_with_images(
        views,
        points[on],
        Chain(chain.measured[there], chain.variance[there], chain.likeness[there]),
        view.slant(pixels[on]),
        np.abs(np.array(there) - start),
        scene.radius,
    )
    placed = np.ix_(np.array(there), on)
    found.positions[placed], found.visible[placed] = seen.positions, seen.visible
    found.uncertainty[placed], found.measured[placed] = seen.uncertainty, seen.measured
    found.features[placed] = seen.features
    found.points[on] = seen.points
    found.positions[start, on], found.visible[start, on] = xy[on], True
    return found


def combine_with_images(
    views: list[Drawn], points: Array, chain: Chain, slant: Array, gap: NDArray[np.int64], radius: float
) -> Followed:
    """Surface points brought together with what the images say of them.

    Args:
        views: T views.
        points: ``(N, 3)`` on the surface as it is drawn.
        chain: What the images say.
        slant: ``(N,)`` cosine between ray and surface where the points were asked for.
        gap: ``(T,)`` views from there.
        radius: The radius of the object.
    """
    variance, measured = chain.variance, chain.measured
    moved, share = _landmarks(views, points, measured, variance, _HELD * radius)
    predicted, seen = (
        np.stack(part) for part in zip(*(one.sees(moved, _SEEN * radius) for one in views), strict=True)
    )
    believed = (share > _BELIEVED) & np.isfinite(predicted).all(2)
    left = np.where(believed[..., None], measured - predicted, 0.0)
    spread = (left**2).sum((0, 2)) / 2 / np.maximum(believed.sum(0), 1)
    own = np.maximum(spread, _LEAST_DEVIATION**2)
    gain = np.where(believed, own / (own + np.where(believed, variance, 1.0)), 0.0)
    unlike = (chain.likeness > -1) & (chain.likeness < _UNLIKE)
    evidence = Evidence(
        variance=np.where(believed, variance, np.inf),
        spread=spread,
        views=believed.sum(0),
        slant=slant,
        gap=gap,
    )
    scales = np.stack([one.window.scales.mean() for one in views])[:, None]
    positions = np.stack(
        [one.to_frame(xy) for one, xy in zip(views, predicted + gain[..., None] * left, strict=True)]
    )
    return Followed(
        positions,
        seen & ~unlike,
        expected_error(evidence) / scales,
        believed,
        moved,
        error_features(evidence),
    )


def _landmarks(
    views: list[Drawn], points: Array, measured: Array, variance: Array, held: float
) -> tuple[Array, Array]:
    """Points moved to where all views see them, and the share of its weight that each measurement kept."""
    deviation = np.sqrt(variance + _DEVIATION**2)
    intrinsics, poses = np.stack([v.intrinsics for v in views]), np.stack([v.T_cam_obj for v in views])
    moved, weight = intersect(points, intrinsics, poses, measured, deviation, held)
    with np.errstate(invalid="ignore"):
        return moved, np.where(np.isfinite(deviation), weight * deviation**2, 0.0)


# Predicts the error in pixels of a tracked point.
#
# The logarithm of the error is a sum of logarithms of what is known about the point; the weights were fitted on
# sequences of a seed, see ``training/point_uncertainty.py``, and tested on those of another one.

MEASURED = (-1.277, 0.028, 0.229, 0.27, -0.911, 0.498)
PREDICTED = (1.813, 0.417, 0.069, -0.392, 0.097, 0.657)
"""Weights of `error_features`, of points that the image corrected and of those that it did not."""
FEATURES = len(MEASURED)
"""How many there are."""
_UNMEASURED = 1.0  # squared pixels


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known about N points in T views."""

    variance: Array  # (T, N) squared pixels of the measurement; infinite if there is none
    spread: Array  # (N,) mean squared pixels between measurements and the landmark
    views: NDArray[np.int64]  # (N,) in how many views the point was measured
    slant: Array  # (N,) cosine between ray and surface where the point was asked for
    gap: NDArray[np.int64]  # (T,) views from there

    @property
    def measured(self) -> NDArray[np.bool_]:
        """``(T, N)``: whether the image had a say."""
        return np.isfinite(self.variance)


def error_features(evidence: Evidence) -> Array:
    """``(T, N, 6)``: one, and logarithms that are small for points that are known well."""
    shape = evidence.variance.shape
    known = np.where(evidence.measured, evidence.variance, _UNMEASURED)
    parts = (
        np.ones(shape),
        np.log(known + 1e-3),
        np.broadcast_to(np.log(evidence.spread + 1e-2), shape),
        np.broadcast_to(np.log(evidence.views + 1.0), shape),
        np.broadcast_to(np.log(evidence.slant + 0.1), shape),
        np.broadcast_to(np.log(evidence.gap + 1.0)[:, None], shape),
    )
    return np.stack(parts, 2)


def expected_error(evidence: Evidence) -> Array:
    """``(T, N)`` pixels: twice as much holds some 19 of 20 errors."""
    known = error_features(evidence)
    logarithm = np.where(evidence.measured, known @ np.array(MEASURED), known @ np.array(PREDICTED))
    error: Array = np.exp(np.clip(logarithm, -3.0, 5.0))
    return error
