"""Affine structure from motion: poses and points without an initialization, up to a reversal in depth.

Each frame is first rotated so that the points' centre lies on the optical axis; a small object is then seen under
scaled orthography, and its tracks span three dimensions (Tomasi and Kanade, "Shape and motion from image streams
under orthography", IJCV 1992). In coordinates in which frame 0 shows x and y as they are, three unknowns of the depth
``z = a x + b y + c zeta`` remain. Scaled orthography gives two equations in them for every further frame. With one
such frame the amount of relief, ``c``, stays free (Koenderink and van Doorn, "Affine structure from motion", 1991),
and its sign always does (Necker reversal).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking3d.bundle_adjustment.adjustment import Structure
from tracking3d.bundle_adjustment.reprojection import FloatArray

_SAMPLES = 200
_UPGRADE_STEPS = 15


@dataclass(frozen=True, eq=False)
class AffineMotion:
    """Points and frames under scaled orthography, with the depth still unknown."""

    axes: FloatArray  # (F, 3, 3) rotation of each frame that maps the points' centre onto the optical axis
    centres: FloatArray  # (F, 3) direction of the points' centre in camera coordinates, with depth 1
    cameras: FloatArray  # (F, 2, 3); that of frame 0 is [1 0 0; 0 1 0]
    shape: FloatArray  # (N, 3) x, y and zeta, which is uncorrelated with x and y and as wide as they are
    inliers: NDArray[np.bool_]  # (N,) bool
    relief: float  # root mean square in pixels of the tracks' third dimension; 0 for a plane
    unexplained: float  # root mean square in pixels of the inliers' residuals to three dimensions


def affine_motion(pixels: FloatArray, K: FloatArray, threshold: float, seed: int) -> AffineMotion | None:
    """Factorize tracks of points seen in all frames; None if there are fewer than two frames or six points.

    Args:
        pixels: ``(F, N, 2)``, all finite.
        K: ``(3, 3)``.
        threshold: Largest distance in pixels of an inlier, root mean square over the frames.
        seed: Seed of the sampling that finds inliers.
    """
    frames, count = pixels.shape[:2]
    if frames < 2 or count < 6:
        return None
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    rays = np.concatenate([(pixels - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones((frames, count, 1))], -1)
    axes = np.array([align_with_axis(np.append(np.median(ray[:, :2], 0), 1.0)) for ray in rays])
    turned = rays @ axes.transpose(0, 2, 1)
    flat = turned[..., :2] / turned[..., 2:]
    rows = flat.transpose(0, 2, 1).reshape(2 * frames, count)
    inliers = _is_consistent(rows, threshold / focal * np.sqrt(frames), seed)
    if np.count_nonzero(inliers) < 6:
        return None
    mean = rows[:, inliers].mean(1)
    left, values, _ = np.linalg.svd(rows[:, inliers] - mean[:, None], full_matrices=False)
    motion = left[:, :3]
    first = motion[:2]
    if np.linalg.svd(first, compute_uv=False)[1] < 1e-9 or values[1] < 1e-12:
        return None
    null = np.linalg.svd(first)[2][2]
    basis = np.column_stack([np.linalg.pinv(first), null])
    shape = np.linalg.solve(basis, motion.T @ (rows - mean[:, None])).T
    x_y, zeta = shape[inliers, :2], shape[inliers, 2]
    linear = np.linalg.lstsq(x_y, zeta, rcond=None)[0]
    unit = max(float((zeta - x_y @ linear).std()), 1e-12) / float(x_y.std())
    shape[:, 2] = (shape[:, 2] - shape[:, :2] @ linear) / unit
    basis[:, :2] += np.outer(basis[:, 2], linear)
    basis[:, 2] *= unit
    centre = np.concatenate([mean.reshape(frames, 2), np.ones((frames, 1))], 1)
    unit_of_values = focal / float(np.sqrt(frames * np.count_nonzero(inliers)))
    directions = np.einsum("fji,fj->fi", axes, centre)
    return AffineMotion(
        axes,
        directions / directions[:, 2:],
        (motion @ basis).reshape(frames, 2, 3),
        shape,
        inliers,
        float(values[2]) * unit_of_values,
        float(np.sqrt(np.sum(values[3:] ** 2))) * unit_of_values,
    )


def measured_relief(affine: AffineMotion) -> tuple[float, float, float] | None:
    """``(a, b, c)`` of the depth from the linear equations of all frames, c > 0; None if noise dominates."""
    matrix, right = [], []
    for camera in affine.cameras[1:]:
        A, d = camera[:, :2], camera[:, 2]
        G, D = A @ A.T, np.outer(d, d)
        by = [np.outer(A[:, k], d) + np.outer(d, A[:, k]) for k in range(2)]
        for part in (lambda m: m[0, 0] - m[1, 1], lambda m: 2 * m[0, 1]):
            matrix.append([-part(by[0]), -part(by[1]), part(D)])
            right.append(-part(G))
    if len(matrix) < 4:
        return None
    p, q, h = np.linalg.lstsq(np.array(matrix), np.array(right), rcond=None)[0]
    square = h - p * p - q * q
    if not square > 1e-6:
        return None
    c = 1 / float(np.sqrt(square))
    return float(p) * c, float(q) * c, c


def assumed_relief(affine: AffineMotion, c: float) -> tuple[float, float, float]:
    """``(a, b, c)`` with a given c: the a and b for which the frames are nearest to scaled orthography."""
    guess = np.zeros(2)
    for _ in range(_UPGRADE_STEPS):
        value = _skewness(affine, guess, c)
        slope = np.column_stack([(_skewness(affine, guess + d, c) - value) / 1e-6 for d in 1e-6 * np.eye(2)])
        step = np.linalg.lstsq(slope.T @ slope + 1e-6 * np.eye(2), -slope.T @ value, rcond=None)[0]
        guess = guess + np.clip(step, -0.5, 0.5)
    return float(guess[0]), float(guess[1]), c


def metric_structure(
    affine: AffineMotion, depth: tuple[float, float, float], t0: FloatArray, z0: float
) -> Structure:
    """Poses and points for a depth ``(a, b, c)``, with frame 0 at identity and ``t0``, and the points' centre at z0.

    The depth reversal has the negative of all three.
    """
    cameras = _metric(affine, depth[:2], depth[2])
    left, values, right = np.linalg.svd(cameras, full_matrices=False)
    rows = left @ right
    turned = np.concatenate([rows, np.cross(rows[:, 0], rows[:, 1])[:, None]], 1)
    scales = values.mean(1)
    R = affine.axes.transpose(0, 2, 1) @ turned @ affine.axes[0]
    R = R @ R[0].T
    # Distances along each frame's own axis, relative to frame 0.
    along = np.linalg.norm(affine.centres, axis=1)
    centres = affine.centres * (z0 * along[0] / along / (scales / scales[0]))[:, None]
    z = affine.shape @ np.array(depth)
    X = np.column_stack([affine.shape[:, :2], z]) * (z0 * along[0]) @ affine.axes[0]
    t = centres + R @ (t0 - centres[0])
    return Structure(R, t, X + centres[0] - t0)


def _metric(affine: AffineMotion, plane: tuple[float, float] | FloatArray, c: float) -> FloatArray:
    """``(F, 2, 3)`` cameras in x, y and the metric depth."""
    # zeta = (z - a x - b y) / c.
    relief = affine.cameras[:, :, 2:] / c
    return np.concatenate([affine.cameras[:, :, :2] - relief * np.asarray(plane), relief], 2)


def _skewness(affine: AffineMotion, plane: FloatArray, c: float) -> FloatArray:
    """Each camera's deviation from scaled orthography, ``(2 (F - 1),)``, and a weak prior for no tilt."""
    cameras = _metric(affine, plane, c)[1:]
    gram = cameras @ cameras.transpose(0, 2, 1)
    skew = np.concatenate([gram[:, 0, 0] - gram[:, 1, 1], 2 * gram[:, 0, 1]])
    return np.concatenate([skew, 1e-3 * plane])


def align_with_axis(direction: FloatArray) -> FloatArray:
    """The smallest rotation ``(3, 3)`` that maps a direction onto the optical axis."""
    x, y, z = direction / np.linalg.norm(direction)
    return np.array(
        [
            [1 - x * x / (1 + z), -x * y / (1 + z), -x],
            [-x * y / (1 + z), 1 - y * y / (1 + z), -y],
            [x, y, z],
        ]
    )


def _is_consistent(rows: FloatArray, threshold: float, seed: int) -> NDArray[np.bool_]:
    """``(N,)`` bool: the inliers of the three-dimensional subspace through four columns, by RANSAC."""
    count = rows.shape[1]
    random = np.random.default_rng(seed)
    chosen = np.argsort(random.random((_SAMPLES, count)), 1)[:, :4]
    base = rows[:, chosen]  # (2F, S, 4)
    spans = np.linalg.qr((base[..., 1:] - base[..., :1]).transpose(1, 0, 2))[0]
    away = rows[None] - base[..., 0].T[:, :, None]
    outside = np.sum(away**2, 1) - np.sum((spans.transpose(0, 2, 1) @ away) ** 2, 1)
    cost = np.minimum(outside, threshold**2).sum(1)
    return outside[np.argmin(cost)] <= threshold**2
