"""The pose of a known object from the pixels of its surface points (PnP), with and without an initial pose.

Sampling is OpenCV's USAC over minimal sets of three points; its result depends only on the seed, not on OpenCV's global
generator. The sampled pose, and the initial pose if there is one, are refined under the
Cauchy loss.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from tracking3d.estimation.online.optimization.types import PoseHypothesis
from tracking3d.points.bundle_adjustment.reprojection import EvaluatedPose, FloatArray, finite_rows

_MIN_INLIERS = 4
_SAMPLES = 500
_CONFIDENCE = 0.999
_REFINEMENTS = 2


def pose_from_points(
    points: FloatArray,
    pixels: FloatArray,
    K: FloatArray,
    start: tuple[FloatArray, FloatArray] | None = None,
    *,
    threshold: float,
    seed: int,
) -> PoseHypothesis | None:
    """The pose with most inliers; None if there are fewer than four.

    Args:
        points: ``(N, 3)`` in object coordinates.
        pixels: ``(N, 2)`` where they are seen. Rows that are not finite here or in ``points`` are never inliers.
        K: ``(3, 3)``.
        start: ``R`` and ``t`` of an initial pose to refine as well; the better of both poses is returned.
        threshold: Largest distance in pixels of an inlier.
        seed: The seed of the sampling.
    """
    usable = finite_rows(points) & finite_rows(pixels)
    if np.count_nonzero(usable) < _MIN_INLIERS:
        return None
    x, u = points[usable], pixels[usable]
    sampled = _sample_pose(x, u, K, threshold, seed)
    starts = [pose for pose in (sampled, start) if pose is not None]
    found = [_refine_on_inliers(x, u, K, R, t, threshold) for R, t in starts]
    best = max(found, key=lambda one: (one.count, -one.residual), default=None)
    if best is None or best.count < _MIN_INLIERS:
        return None
    inliers = np.zeros(len(points), bool)
    inliers[usable] = best.inliers
    return PoseHypothesis(best.R, best.t, inliers, best.residual)


def pose_of_tracks(
    points: FloatArray,
    pixels: FloatArray,
    weight: FloatArray | None,
    K: FloatArray,
    R: FloatArray,
    t: FloatArray,
    scale: float,
    iterations: int = 10,
) -> EvaluatedPose:
    """The pose of least robust reprojection error near an initial pose; never worse than it.

    Args:
        points: ``(N, 3)`` in object coordinates; rows that are not finite do not count.
        pixels: ``(N, 2)``, likewise.
        weight: ``(N,)``; all the same if None.
        K: ``(3, 3)``.
        R: ``(3, 3)`` and
        t: ``(3,)`` of the initial pose.
        scale: Residual in pixels at which the loss is ``log 2``.
        iterations: The most steps that are tried.
    """
    from tracking3d.estimation.online.optimization.kernels import pnp

    share = _shares(points, pixels, weight)
    return pnp.pose_of_tracks(points, pixels, share, K, R, t, scale, iterations)


def _shares(points: FloatArray, pixels: FloatArray, weight: FloatArray | None) -> FloatArray:
    """``(N,)`` shares of the weight; 0 for rows that are not finite."""
    usable = finite_rows(points) & finite_rows(pixels)
    given = 1.0 if weight is None else np.nan_to_num(weight).clip(0.0)
    share = np.where(usable, given, 0.0)
    return share / max(float(share.sum()), 1e-12)


def _sample_pose(
    points: FloatArray, pixels: FloatArray, K: FloatArray, threshold: float, seed: int
) -> tuple[FloatArray, FloatArray] | None:
    settings = cv2.UsacParams()
    settings.threshold, settings.confidence = threshold, _CONFIDENCE
    settings.maxIterations, settings.randomGeneratorState = _SAMPLES, seed
    # `_refine_on_inliers` finds the same poses without it (measured, up to 80 % outliers), in a third of the time.
    settings.loMethod = cv2.LOCAL_OPTIM_NULL
    try:
        found, _, turn, t, _ = cv2.solvePnPRansac(
            points, pixels, K.astype(np.float64), np.zeros(4), params=settings
        )
    except cv2.error:
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(t).all()):
        return None
    return cv2.Rodrigues(turn)[0], t.ravel()


def _refine_on_inliers(
    points: FloatArray, pixels: FloatArray, K: FloatArray, R: FloatArray, t: FloatArray, threshold: float
) -> PoseHypothesis:
    """A pose after refinement over its inliers."""
    for _ in range(_REFINEMENTS):
        fit = pose_of_tracks(points, pixels, None, K, R, t, threshold / 2)
        R, t = fit.R, fit.t
    residual = fit.details
    inliers = residual <= threshold
    rms = math.sqrt(np.mean(residual[inliers] ** 2)) if inliers.any() else math.inf
    return PoseHypothesis(R, t, inliers, rms)
