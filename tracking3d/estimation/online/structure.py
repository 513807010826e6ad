"""Poses and points of the first frames from tracks alone: several hypotheses, because the image allows several.

A small object is seen almost without perspective. Its reversal in depth (Necker) then fits nearly as well as itself,
with two views any amount of relief does (bas-relief), and a plane turns one way or the other. So hypotheses are
made, refined under perspective by `tracking3d.estimation.online.bundle`, and the distinct ones are kept: which of
them is right shows when they are rendered.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.estimation.online.bundle import Structure, Tracks, adjust
from tracking3d.estimation.online.factorization import (
    affine_motion,
    assumed_relief,
    measured_relief,
    metric_structure,
    onto_axis,
)
from tracking3d.estimation.online.pose_from_points import pose_of_tracks
from tracking3d.estimation.online.reprojection import FloatArray, finite_rows

RELIEFS = (0.25, 0.5, 1.0)
"""Depths that are tried where views do not tell it: spread about the tilted plane over the spread in x and y."""

SLANTS = (25.0, 50.0)
"""Degrees by which planes are tried to be tilted, in eight directions."""

_CORE_FRAMES, _CORE_POINTS, _CORE_ITERATIONS = 8, 80, 10
_FEWEST_COMMON = 8
_FEWEST = 6
_FINAL_ITERATIONS = 15
_NEW_POINT_ITERATIONS = 6
_SAME_DEGREES = 2.0
_IN_FRONT = 0.4


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
    """Distinct explanations of the tracks, the cheapest first; the reversal in depth of the best is among them.

    Frame 0 is at identity and ``t0`` in all of them. Each says in `Structure.origin` where it comes from:
    ``affine`` (factorization), ``relief`` (the same with an assumed amount of depth), ``convex`` (points on an
    ellipsoid's front), ``tilted`` (points on a plane), ``homography``, or ``mirrored`` (the reversal of another).

    Args:
        tracks: F frames, N points; frame 0 is the first.
        K: ``(3, 3)``.
        t0: ``(3,)`` translation of frame 0, at the object's centre.
        radius: Of the object, in its units.
        scale: Residual in pixels at which the Cauchy loss is ``log 2``.
        keep: The most answers.
        seed: Of the sampling that finds outliers.

    Returns:
        Structures of all frames and points. A point seen in fewer than two frames is nan; a frame that sees
        too few points has the pose of its neighbour. Empty if no two frames share six points.
    """
    frames, points = _core(tracks, seed)
    if len(frames) < 2:
        return []
    part = _part(tracks, frames, points)
    z0 = float(t0[2]) - _IN_FRONT * radius
    # Barely visible parallax lets points run away; staying where they were assumed costs little elsewhere.
    hold = 0.05 / radius**2
    found = [
        replace(refined, origin=start.origin)
        for start in _starts(part, K, t0, z0, radius, scale, seed)
        for refined in [_refined(part, K, start, scale, _CORE_ITERATIONS, hold)]
    ]
    distinct = _distinct(found)[:keep]
    if not distinct:
        return []
    partner = _refined(part, K, mirrored(distinct[0]), scale, _CORE_ITERATIONS, hold)
    if len(_distinct([*distinct, partner])) > len(distinct):
        distinct = [*distinct[: keep - 1], partner]
    whole = [_completed(tracks, K, one, frames, points, scale) for one in distinct]
    final = [
        replace(adjust(tracks, K, one, scale=scale, iterations=_FINAL_ITERATIONS), origin=one.origin)
        for one in whole
    ]
    return _distinct(final)


def mirrored(structure: Structure) -> Structure:
    """The Necker reversal: the points reversed in depth about their centre, turning the other way.

    Without perspective no image tells it from ``structure``. Frame 0 keeps its pose.
    """
    known = finite_rows(structure.points)
    centre = np.median(structure.points[known], 0)
    seen = structure.R @ centre + structure.t
    axes = np.array([onto_axis(direction) for direction in seen])
    flip = axes.transpose(0, 2, 1) @ np.diag([1.0, 1.0, -1.0]) @ axes
    flip0 = structure.R[0].T @ flip[0] @ structure.R[0]
    R = flip @ structure.R @ flip0
    points = (structure.points - centre) @ flip0 + centre
    return replace(structure, R=R, t=seen - R @ centre, points=points, origin="mirrored")


def motion_enough(tracks: Tracks) -> float:
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
        if np.count_nonzero(both) >= _FEWEST:
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
    if most < _FEWEST:
        return np.arange(1), np.arange(0)
    points = np.flatnonzero(seen[best].all(0))
    chosen = np.random.default_rng(seed).permutation(points)[:_CORE_POINTS]
    return best, np.sort(chosen)


def _part(tracks: Tracks, frames: NDArray[np.intp], points: NDArray[np.intp]) -> Tracks:
    at = np.ix_(frames, points)
    return Tracks(tracks.pixels[at], tracks.visible[at], tracks.weights()[at])


def _refined(
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
    tracks: Tracks, K: FloatArray, t0: FloatArray, z0: float, radius: float, scale: float, seed: int
) -> Iterator[Structure]:
    """Unrefined hypotheses; all points are seen in all frames."""
    affine = affine_motion(tracks.pixels, K, 3 * scale, seed)
    if affine is not None:
        measured = measured_relief(affine)
        depths = [("relief", assumed_relief(affine, c)) for c in RELIEFS]
        for origin, (a, b, c) in [("affine", measured)] * (measured is not None) + depths:
            for sign in (1, -1):
                start = metric_structure(affine, (sign * a, sign * b, sign * c), t0, z0)
                yield replace(start, origin=origin)
    rays = np.column_stack(
        [(tracks.pixels[0] - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones(tracks.pixels.shape[1])]
    )
    yield from _homographies(tracks, K, t0, z0, rays, scale)
    flat = (rays[:, :2] - np.median(rays[:, :2], 0)) * z0
    outward = np.einsum("ni,ij,nj->n", flat, np.linalg.pinv(np.cov(flat.T)), flat)
    # Uniform points of an ellipse have Mahalanobis distances up to 4; the front is nearer at the centre.
    front = -np.sqrt(np.maximum(1 - outward / 5, 0.0)) * min(radius, 2 * float(flat.std(0).min()))
    depths_of = [("convex", front - np.median(front))]
    for direction in np.radians(np.arange(0, 360, 45)):
        slope = flat @ [np.cos(direction), np.sin(direction)]
        depths_of += [("tilted", np.tan(np.radians(slant)) * slope) for slant in SLANTS]
    for origin, depth in depths_of:
        depth = np.maximum(depth, -0.5 * z0)
        yield replace(_resected(tracks, K, rays * (z0 + depth)[:, None] - t0, t0, scale), origin=origin)


def _homographies(
    tracks: Tracks, K: FloatArray, t0: FloatArray, z0: float, rays: FloatArray, scale: float
) -> Iterator[Structure]:
    """The plane's positions that a homography from the first to the last frame allows."""
    H, _ = cv2.findHomography(tracks.pixels[0], tracks.pixels[-1], cv2.RANSAC, 3 * scale)
    if H is None or H.shape != (3, 3) or not np.isfinite(H).all():
        return
    _, _, _, normals = cv2.decomposeHomographyMat(H, K)
    for normal in normals:
        along = rays @ normal.ravel()
        # A plane nearly through the camera's centre has no sensible depths.
        if along.min() * along.max() <= 0 or np.abs(along).max() > 20 * np.abs(along).min():
            continue
        depth = z0 * np.median(along) / along
        start = _resected(tracks, K, rays * depth[:, None] - t0, t0, scale)
        yield replace(start, origin="homography")


def _resected(tracks: Tracks, K: FloatArray, points: FloatArray, t0: FloatArray, scale: float) -> Structure:
    """Every frame's pose from given points, each started from the one before."""
    R, t = [np.eye(3)], [t0]
    for pixels in tracks.pixels[1:]:
        fit = pose_of_tracks(points, pixels, None, K, R[-1], t[-1], 3 * scale)
        R.append(fit.R)
        t.append(fit.t)
    return Structure(np.array(R), np.array(t), points)


def _completed(
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
        if np.count_nonzero(seen[frame] & finite_rows(X)) >= _FEWEST:
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
    # On the ray of the first frame that sees it, as deep as the points known.
    first = seen[:, new].argmax(0)
    R, t = structure.R[first], structure.t[first]
    centre = np.median(structure.points[known], 0)
    depth = (R @ centre + t)[:, 2]
    pixel = tracks.pixels[first, new]
    ray = np.column_stack([(pixel - K[:2, 2]) / [K[0, 0], K[1, 1]], np.ones(len(new))])
    guess = np.einsum("nji,nj->ni", R, ray * depth[:, None] - t)
    frames = np.flatnonzero(posed)
    start = Structure(structure.R[frames], structure.t[frames], guess)
    part = _part(tracks, frames, new)
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


def _distinct(structures: list[Structure]) -> list[Structure]:
    """By cost, without those whose poses are those of a cheaper one."""
    kept: list[Structure] = []
    for one in sorted(structures, key=lambda structure: structure.cost):
        if np.isfinite(one.cost) and all(_apart(one, other) > _SAME_DEGREES for other in kept):
            kept.append(one)
    return kept


def _apart(a: Structure, b: Structure) -> float:
    """Largest angle in degrees between two structures' rotations of a frame."""
    return float(np.degrees(Rotation.from_matrix(a.R @ b.R.transpose(0, 2, 1)).magnitude()).max())
