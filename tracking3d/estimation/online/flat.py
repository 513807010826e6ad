"""Poses of a flat object from tracks of its points: two unknowns of its plane, and every frame's pose.

Free points make a flat object bulge and its motion wrong: almost any relief explains a plane that turns a little.
Without perspective its tilt is hardly told either (whole families of tilts and motions have the same images), so
several answers are given.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from tracking3d.bundle_adjustment.adjustment import AdjustmentProblem, Structure, System, Tracks, adjust
from tracking3d.bundle_adjustment.reprojection import FloatArray
from tracking3d.estimation.online.pose_from_points import pose_of_tracks

SLANTS = (25.0, 50.0)
"""Degrees by which planes are tried to be tilted, in eight directions."""

_STARTS = 4
_SCREENED_POINTS = 40
_ITERATIONS = 25
_STEEPEST = 5.0
_SAME_TILT = 0.3
_CONVERGED = 1e-6


def looks_flat(tracks: Tracks, K: FloatArray, threshold: float) -> bool:
    """Whether homographies take frame 0's points to every other frame, within a median distance in pixels.

    So it does, too, for any object that has hardly turned. All points are seen in all frames; K says nothing here
    but how pixels are scaled.
    """
    focal = np.array([K[0, 0], K[1, 1]])
    first = (tracks.pixels[0] - K[:2, 2]) / focal
    for pixels in tracks.pixels[1:]:
        then = (pixels - K[:2, 2]) / focal
        H, _ = cv2.findHomography(first, then, cv2.LMEDS)
        if H is None:
            return False
        away = cv2.perspectiveTransform(first[:, None], H)[:, 0] - then
        if not np.median(np.linalg.norm(away * focal, axis=1)) < threshold:
            return False
    return True


def flat_structures(
    tracks: Tracks, K: FloatArray, t0: FloatArray, z0: float, scale: float
) -> list[Structure]:
    """Planes and poses that explain the tracks, the cheapest first; the same one may occur twice.

    Args:
        tracks: F frames, N points, all seen in all frames.
        K: ``(3, 3)``.
        t0: ``(3,)`` translation of frame 0.
        z0: Depth of the points' centre in frame 0.
        scale: Residual in pixels at which the Cauchy loss is ``log 2``.
    """
    rays = np.column_stack(
        [(tracks.pixels[0] - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones(tracks.pixels.shape[1])]
    )
    share = np.arange(0, len(rays), max(len(rays) // _SCREENED_POINTS, 1))
    few = Tracks(tracks.pixels[:, share], tracks.visible[:, share])
    screened = []
    for tilt in _tilts(tracks, K, rays, scale):
        points = _on_plane(rays, tilt, z0)
        if points is not None:
            start = resected(few, K, points[share] - t0, t0, scale)
            screened.append((adjust(few, K, start, scale=scale, iterations=0).cost, tilt))
    screened.sort(key=lambda pair: pair[0])
    chosen: list[FloatArray] = []
    for _, tilt in screened:
        if all(np.linalg.norm(tilt - other) > _SAME_TILT for other in chosen):
            chosen.append(tilt)
    found = [_fitted(tracks, K, rays, tilt, t0, z0, scale) for tilt in chosen[:_STARTS]]
    return sorted(found, key=lambda structure: structure.cost)


def resected(tracks: Tracks, K: FloatArray, points: FloatArray, t0: FloatArray, scale: float) -> Structure:
    """Every frame's pose from given points ``(N, 3)``, each started from the one before."""
    R, t = [np.eye(3)], [t0]
    for pixels in tracks.pixels[1:]:
        fit = pose_of_tracks(points, pixels, None, K, R[-1], t[-1], 3 * scale)
        R.append(fit.R)
        t.append(fit.t)
    return Structure(np.array(R), np.array(t), points)


def _tilts(tracks: Tracks, K: FloatArray, rays: FloatArray, scale: float) -> list[FloatArray]:
    """``(2,)`` slopes, see `_on_plane`: a fan, and what the last frame's homography says."""
    tilts = [np.zeros(2)]
    for direction in np.radians(np.arange(0, 360, 45)):
        tilts += [
            np.tan(np.radians(slant)) * np.array([np.cos(direction), np.sin(direction)]) for slant in SLANTS
        ]
    H, _ = cv2.findHomography(tracks.pixels[0], tracks.pixels[-1], cv2.RANSAC, 3 * scale)
    if H is not None and H.shape == (3, 3) and np.isfinite(H).all():
        centre = np.median(rays, 0)
        for normal in cv2.decomposeHomographyMat(H, K)[3]:
            towards = float(normal.ravel() @ centre)
            if abs(towards) > 1e-3:
                tilts.append(-normal.ravel()[:2] / towards)
    return [tilt for tilt in tilts if np.linalg.norm(tilt) < _STEEPEST]


def _on_plane(rays: FloatArray, tilt: FloatArray, z0: float) -> FloatArray | None:
    """``(N, 3)`` points in camera coordinates on ``1 / z = (1 - tilt . offset) / z0``; None if any is behind.

    Offsets are those of rays of depth 1 from their median, so that the tilt is the slope of depth over width.
    """
    inverse = (1 - (rays - np.median(rays, 0))[:, :2] @ tilt) / z0
    return rays / inverse[:, None] if inverse.min() > 0.2 / z0 else None


def _fitted(
    tracks: Tracks, K: FloatArray, rays: FloatArray, tilt: FloatArray, t0: FloatArray, z0: float, scale: float
) -> Structure:
    """Poses and tilt of least cost by Levenberg-Marquardt from a start; points stay on frame 0's rays."""
    offset = (rays - np.median(rays, 0))[:, :2]
    points = _on_plane(rays, tilt, z0)
    assert points is not None
    free = np.zeros(len(points))
    problem = AdjustmentProblem(
        tracks.pixels, tracks.weights(), K, 1, scale, False, np.zeros_like(points), free
    )
    best, damping = problem.evaluated(resected(tracks, K, points - t0, t0, scale)), 1e-3
    for _ in range(_ITERATIONS):
        step = -_plane_step(problem.linearised(best), best.points + t0, offset / z0, damping)
        moved_points = _on_plane(rays, tilt + step[-2:], z0)
        if moved_points is None:
            damping *= 10
            continue
        new = problem.evaluated(problem.stepped(best, step[:-2], moved_points - t0 - best.points))
        if not new.cost < best.cost:
            damping *= 10
            continue
        settled = best.cost - new.cost < _CONVERGED * best.cost
        best, tilt, damping = new, tilt + step[-2:], damping / 10
        if settled:
            break
    return adjust(tracks, K, replace(best, origin="flat"), scale=scale, iterations=0)


def _plane_step(system: System, place: FloatArray, offset: FloatArray, damping: float) -> FloatArray:
    """``(C + 2,)`` damped step against the gradient, of poses and tilt.

    Args:
        system: Of poses and free points.
        place: ``(N, 3)`` points in frame 0's camera coordinates.
        offset: ``(N, 2)`` of `_on_plane`, over ``z0``.
        damping: Of Levenberg and Marquardt.
    """
    by_tilt = place[:, :, None] * (place[:, 2:] * offset)[:, None]  # (N, 3, 2)
    border = np.einsum("njc,njk->ck", system.coupling, by_tilt)
    corner = np.einsum("nik,nij,njl->kl", by_tilt, system.points, by_tilt)
    matrix = np.block([[system.poses, border], [border.T, corner]])
    gradient = np.append(system.poses_gradient, np.einsum("njk,nj->k", by_tilt, system.points_gradient))
    diagonal = matrix.diagonal()
    step: FloatArray = np.linalg.solve(
        matrix + np.diag(damping * diagonal + 1e-9 * diagonal.max() + 1e-12), gradient
    )
    return step
