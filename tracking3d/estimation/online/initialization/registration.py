"""Registers all frames, given poses and points of some: poses from points, points from poses, then both together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tracking3d.bundle_adjustment.adjustment import Structure, Tracks, adjust
from tracking3d.bundle_adjustment.reprojection import FloatArray, finite_rows
from tracking3d.estimation.online.optimization.pnp import pose_of_tracks

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
