"""Poses and points of the first frames from tracks alone: several hypotheses, because the image allows several.

A small object is seen almost without perspective. Its reversal in depth (Necker) then fits nearly as well as itself,
with two views any amount of relief does (bas-relief), and a plane has two rotations. So several hypotheses are
refined under perspective by `tracking3d.points.bundle_adjustment.adjustment`, and the distinct ones are kept;
rendering them shows which is correct.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.online.optimization.pnp import pose_of_tracks
from tracking3d.geometry.levenberg_marquardt import Damping, damped, minimizer
from tracking3d.points.bundle_adjustment.adjustment import (
    AdjustmentProblem,
    Structure,
    System,
    Tracks,
    adjust,
)
from tracking3d.points.bundle_adjustment.reprojection import FloatArray, finite_rows

RELIEFS = (0.3, 0.7)
"""Depths that are tried if the views do not constrain it: spread about the tilted plane over the spread in x and y."""

_CORE_FRAMES, _CORE_POINTS, _SCREENING_ITERATIONS, _CORE_ITERATIONS = 8, 80, 4, 10
_FEWEST_COMMON = 8
_SAME_DEGREES = 2.0
_IN_FRONT = 0.4
_SUFFICES = 1.5


def structure_hypotheses(
    tracks: Tracks,
    K: FloatArray,
    t0: FloatArray,
    radius: float = 0.9,
    *,
    scale: float = 1.0,
    keep: int = 4,
    seed: int = 0,
) -> list[Structure]:
    """Distinct explanations of the tracks, the cheapest first, with reversals in depth if they fit.

    Flat ones are tried where homographies explain the tracks. Free points then fit better because they bend to the
    noise, so flat ones come first if the noise that they leave is not much larger, counted by degrees of freedom.
    So they do for a solid that has hardly turned: at 0.3 pixels of noise and a radius of 80 pixels, by less than
    6 degrees.

    Frame 0 is at identity and ``t0`` in all of them. Each says in `Structure.origin` where it comes from:
    ``affine`` (factorization), ``relief`` (the same with an assumed amount of depth) or ``flat`` (a plane).

    Args:
        tracks: F frames, N points; frame 0 is the first.
        K: ``(3, 3)``.
        t0: ``(3,)`` translation of frame 0, at the object's centre.
        radius: The radius of the object, in its units.
        scale: Residual in pixels at which the Cauchy loss is ``log 2``.
        keep: The most solutions.
        seed: The seed of the sampling that finds outliers.

    Returns:
        Structures of all frames and points. A point seen in fewer than two frames is nan; a frame that sees
        too few points has the pose of its neighbour. Empty if no two frames share six points.
    """
    frames, points = _core(tracks, seed)
    if len(frames) < 2:
        return []
    part = subset_of(tracks, frames, points)
    z0 = float(t0[2]) - _IN_FRONT * radius
    # Barely visible parallax lets points run away; staying where they were assumed costs little elsewhere.
    hold = 0.05 / radius**2
    screened = [
        _refine(part, K, start, scale, _SCREENING_ITERATIONS, hold)
        for start in _starts(part, K, t0, z0, scale, seed)
    ]
    found = [_refine(part, K, one, scale, _CORE_ITERATIONS, hold) for one in _distinct(screened)[: keep + 2]]
    distinct = _distinct(found)[:keep]
    if is_planar(part, K, scale):
        flat = _distinct(planar_structures(part, K, t0, z0, scale))[:2]
        distinct = flat + distinct[: max(keep - len(flat), 0)]
    whole = _distinct([register_all(tracks, K, one, frames, points, scale) for one in distinct])
    free = min((_noise(one, 3) for one in whole if one.origin != "flat"), default=np.inf)
    return sorted(whole, key=lambda one: not (one.origin == "flat" and _noise(one, 2) < _SUFFICES * free))


def image_deformation(tracks: Tracks) -> float:
    """How far the image of the points has changed its form since frame 0, as a share of the object's size.

    Per frame: the median distance between its points and a robust similarity (shift, turn, scale) of frame 0's,
    over the root mean square distance of frame 0's points from their centre; the largest of all frames. A
    similarity says nothing about depth, everything else does: 0.03 to 0.05 is a turn of about 10 degrees of a
    rounded object. 0 if no frame shares six points with the first.
    """
    seen = tracks.weights() > 0
    largest = 0.0
    for frame in range(1, len(seen)):
        both = seen[0] & seen[frame]
        if np.count_nonzero(both) >= FEWEST:
            largest = max(largest, _deformation(tracks.pixels[0, both], tracks.pixels[frame, both]))
    return largest


def _deformation(before: FloatArray, after: FloatArray) -> float:
    # A similarity of the plane is linear in complex numbers.
    x, y = (points[:, 0] + 1j * points[:, 1] for points in (before, after))
    weight = np.ones(len(x))
    for _ in range(5):
        share = weight / weight.sum()
        x0, y0 = x - share @ x, y - share @ y
        turn = (share * x0.conj()) @ y0 / max(float(share @ np.abs(x0) ** 2), 1e-12)
        distance = np.abs(y0 - turn * x0)
        weight = 1 / (distance**2 + np.median(distance) ** 2 + 1e-12)
    size = np.sqrt(np.mean(np.abs(x - x.mean()) ** 2))
    return float(np.median(distance) / max(float(size), 1e-12))


def _core(tracks: Tracks, seed: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Frames from the first on, and points seen in all of them: as long a stretch as most points last."""
    seen = tracks.weights() > 0
    enough = max(_FEWEST_COMMON, 0.4 * np.count_nonzero(seen[0]))
    best, most = np.arange(1), 0
    for last in range(len(seen) - 1, 0, -1):
        frames = np.unique(np.linspace(0, last, _CORE_FRAMES).round().astype(int))
        common = int(np.count_nonzero(seen[frames].all(0)))
        if common > most:
            best, most = frames, common
        if common >= enough:
            break
    if most < FEWEST:
        return np.arange(1), np.arange(0)
    points = np.flatnonzero(seen[best].all(0))
    chosen = np.random.default_rng(seed).permutation(points)[:_CORE_POINTS]
    return best, np.sort(chosen)


def _refine(
    tracks: Tracks, K: FloatArray, start: Structure, scale: float, iterations: int, hold: float
) -> Structure:
    refined = adjust(
        tracks,
        K,
        start,
        scale=scale,
        iterations=iterations,
        point_prior=start.points,
        point_prior_weight=hold,
    )
    return replace(refined, origin=start.origin)


def _starts(
    tracks: Tracks, K: FloatArray, t0: FloatArray, z0: float, scale: float, seed: int
) -> Iterator[Structure]:
    """Unrefined hypotheses; all points are seen in all frames."""
    affine = affine_motion(tracks.pixels, K, 3 * scale, seed)
    if affine is not None:
        measured = measured_relief(affine)
        depths = [("relief", assumed_relief(affine, c)) for c in RELIEFS]
        if measured is not None:
            depths.insert(0, ("affine", measured))
        for origin, (a, b, c) in depths:
            for sign in (1, -1):
                start = metric_structure(affine, (sign * a, sign * b, sign * c), t0, z0)
                yield replace(start, origin=origin)


def _noise(structure: Structure, unknowns: int) -> float:
    """Noise of the tracks in pixels if a structure is right, with so many unknowns a point and six a frame."""
    residual = structure.residual[np.isfinite(structure.residual)]
    spare = 2 * residual.size - unknowns * len(structure.points) - 6 * len(structure.R)
    return float(np.median(residual) * np.sqrt(2 * residual.size / max(spare, 1)))


def _distinct(structures: list[Structure]) -> list[Structure]:
    """By cost, without those whose poses are those of a cheaper one; flat ones are compared with flat ones only."""
    kept: list[Structure] = []
    for one in sorted(structures, key=lambda structure: structure.cost):
        alike = [other for other in kept if (other.origin == "flat") == (one.origin == "flat")]
        if np.isfinite(one.cost) and all(_apart(one, other) > _SAME_DEGREES for other in alike):
            kept.append(one)
    return kept


def _apart(a: Structure, b: Structure) -> float:
    """Largest angle in degrees between two structures' rotations of a frame."""
    return float(np.degrees(Rotation.from_matrix(a.R @ b.R.transpose(0, 2, 1)).magnitude()).max())


# Affine structure from motion: poses and points without an initialization, up to a reversal in depth.
#
# Each frame is first rotated so that the points' centre lies on the optical axis; a small object is then seen under
# scaled orthography, and its tracks span three dimensions (Tomasi and Kanade, "Shape and motion from image streams
# under orthography", IJCV 1992). In coordinates in which frame 0 shows x and y as they are, three unknowns of the depth
# ``z = a x + b y + c zeta`` remain. Scaled orthography gives two equations in them for every further frame. With one
# such frame the amount of relief, ``c``, stays free (Koenderink and van Doorn, "Affine structure from motion", 1991),
# and its sign always does (Necker reversal).

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


# Poses of a planar object from tracks of its points: the plane's two unknowns and every frame's pose.
#
# Free points make a planar object bulge and its motion wrong: almost any relief explains a plane that rotates a little.
# Without perspective its tilt is hardly constrained either (whole families of tilts and motions have the same images),
# so several solutions are returned.

SLANTS = (25.0, 50.0)
"""Degrees by which the hypothetical planes are tilted, in eight directions."""

_STARTS = 4
_SCREENED_POINTS = 40
_ITERATIONS = 25
_STEEPEST = 5.0
_SAME_TILT = 0.3
_PLANE_DAMPING = Damping(least=0, most=math.inf, decrease=10, increase=10, converged=1e-6)


@dataclass(frozen=True, eq=False)
class _Plane:
    """Poses and points of a plane."""

    structure: Structure
    tilt: FloatArray  # (2,) see `_on_plane`
    cost: float


def is_planar(tracks: Tracks, K: FloatArray, threshold: float) -> bool:
    """Whether homographies take frame 0's points to every other frame, within a median distance in pixels.

    This also holds for any object that has hardly rotated. All points are seen in all frames; K only scales the pixels.
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


def planar_structures(
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
            start = resect_views(few, K, points[share] - t0, t0, scale)
            screened.append((adjust(few, K, start, scale=scale, iterations=0).cost, tilt))
    screened.sort(key=lambda pair: pair[0])
    chosen: list[FloatArray] = []
    for _, tilt in screened:
        if all(np.linalg.norm(tilt - other) > _SAME_TILT for other in chosen):
            chosen.append(tilt)
    found = [_fit_plane_structure(tracks, K, rays, tilt, t0, z0, scale) for tilt in chosen[:_STARTS]]
    return sorted(found, key=lambda structure: structure.cost)


def resect_views(
    tracks: Tracks, K: FloatArray, points: FloatArray, t0: FloatArray, scale: float
) -> Structure:
    """Every frame's pose from given points ``(N, 3)``, each initialized with the one before."""
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


def _fit_plane_structure(
    tracks: Tracks, K: FloatArray, rays: FloatArray, tilt: FloatArray, t0: FloatArray, z0: float, scale: float
) -> Structure:
    """Poses and tilt of least cost by Levenberg-Marquardt; the points stay on frame 0's rays."""
    offset = (rays - np.median(rays, 0))[:, :2]
    points = _on_plane(rays, tilt, z0)
    assert points is not None
    free = np.zeros(len(points))
    problem = AdjustmentProblem(
        tracks.pixels, tracks.weights(), K, 1, scale, False, np.zeros_like(points), free
    )

    def stepped(problem: AdjustmentProblem, at: _Plane, system: System, damping: float) -> _Plane:
        step = -_plane_step(system, at.structure.points + t0, offset / z0, damping)
        moved = _on_plane(rays, at.tilt + step[-2:], z0)
        if moved is None:
            return replace(at, cost=math.inf)
        shift = moved - t0 - at.structure.points
        new = problem.evaluate(problem.step_by(at.structure, step[:-2], shift))
        return _Plane(new, at.tilt + step[-2:], new.cost)

    first = problem.evaluate(resect_views(tracks, K, points - t0, t0, scale))
    minimize = minimizer(lambda problem, at: problem.linearize(at.structure), stepped)
    best, _ = minimize(problem, _Plane(first, tilt, first.cost), _PLANE_DAMPING, _ITERATIONS)
    return adjust(tracks, K, replace(best.structure, origin="flat"), scale=scale, iterations=0)


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
    step: FloatArray = np.linalg.solve(damped(matrix, damping), gradient)
    return step


FEWEST = 6
"""The fewest points that a frame needs for a pose of its own."""

_NEW_POINT_ITERATIONS = 6
_FINAL_ITERATIONS = 25
_FLAT = 1e3


def register_all(
    tracks: Tracks,
    K: FloatArray,
    core: Structure,
    frames: NDArray[np.intp],
    points: NDArray[np.intp],
    scale: float,
) -> Structure:
    """All frames and points, refined together; a planar solution stays planar."""
    start = _extend(tracks, K, core, frames, points, scale)
    prior, weight = None, 0.0
    if core.origin == "flat":
        known = finite_rows(start.points)
        centre = core.points.mean(0)
        normal = np.linalg.svd(core.points - centre)[2][2]
        prior = start.points - ((start.points - centre) @ normal)[:, None] * normal
        start = replace(start, points=prior)
        weight = _FLAT / float(np.mean((prior[known] - centre) ** 2))
    refined = adjust(
        tracks,
        K,
        start,
        scale=scale,
        iterations=_FINAL_ITERATIONS,
        point_prior=prior,
        point_prior_weight=weight,
    )
    return replace(refined, origin=core.origin)


def _extend(
    tracks: Tracks,
    K: FloatArray,
    core: Structure,
    frames: NDArray[np.intp],
    points: NDArray[np.intp],
    scale: float,
) -> Structure:
    """From some frames and points to all: poses from points, points from poses, outwards in time."""
    seen = tracks.weights() > 0
    count, total = seen.shape
    R, t = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    X = np.full((total, 3), np.nan)
    R[frames], t[frames], X[points] = core.R, core.t, core.points
    posed = np.zeros(count, bool)
    posed[frames] = True
    while not posed.all():
        missing, there = np.flatnonzero(~posed), np.flatnonzero(posed)
        gaps = np.abs(missing[:, None] - there)
        closest = gaps.min(1).argmin()
        frame, near = missing[closest], there[gaps[closest].argmin()]
        if np.count_nonzero(seen[frame] & finite_rows(X)) < np.count_nonzero(seen[frame]) / 2:
            X = _with_new_points(tracks, K, Structure(R, t, X), posed, scale)
        R[frame], t[frame] = R[near], t[near]
        if np.count_nonzero(seen[frame] & finite_rows(X)) >= FEWEST:
            pixels = np.where(seen[frame][:, None], tracks.pixels[frame], np.nan)
            fit = pose_of_tracks(X, pixels, tracks.weights()[frame], K, R[near], t[near], 2 * scale)
            R[frame], t[frame] = fit.R, fit.t
        posed[frame] = True
    return replace(core, R=R, t=t, points=_with_new_points(tracks, K, Structure(R, t, X), posed, scale))


def _with_new_points(
    tracks: Tracks, K: FloatArray, structure: Structure, posed: NDArray[np.bool_], scale: float
) -> FloatArray:
    """``(N, 3)`` points, those included that two frames with poses see."""
    seen = (tracks.weights() > 0) & posed[:, None]
    known = finite_rows(structure.points)
    new = np.flatnonzero(~known & (np.count_nonzero(seen, 0) >= 2))
    if not len(new) or not known.any():
        return structure.points
    # On the ray of the first frame that sees it, at the depth of the known points.
    first = seen[:, new].argmax(0)
    R, t = structure.R[first], structure.t[first]
    centre = np.median(structure.points[known], 0)
    depth = (R @ centre + t)[:, 2]
    pixel = tracks.pixels[first, new]
    ray = np.column_stack([(pixel - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones(len(new))])
    guess = np.einsum("nji,nj->ni", R, ray * depth[:, None] - t)
    frames = np.flatnonzero(posed)
    start = Structure(structure.R[frames], structure.t[frames], guess)
    part = subset_of(tracks, frames, new)
    # A point that hardly moves against the others stays near their depth.
    spread = float(np.mean((structure.points[known] - centre) ** 2)) + 1e-12
    found = adjust(
        part,
        K,
        start,
        fixed=len(frames),
        scale=2 * scale,
        iterations=_NEW_POINT_ITERATIONS,
        point_prior=guess,
        point_prior_weight=0.01 / spread,
    )
    points = structure.points.copy()
    points[new] = found.points
    return points


def subset_of(tracks: Tracks, frames: NDArray[np.intp], points: NDArray[np.intp]) -> Tracks:
    """The tracks of some frames and points; ``frames`` and ``points`` are indices."""
    at = np.ix_(frames, points)
    return Tracks(tracks.pixels[at], tracks.visible[at], tracks.weights()[at])
