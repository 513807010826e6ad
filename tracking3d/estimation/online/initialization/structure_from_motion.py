"""Poses and points of the first frames from tracks alone: several hypotheses, because the image allows several.

A small object is seen almost without perspective. Its reversal in depth (Necker) then fits nearly as well as itself,
with two views any amount of relief does (bas-relief), and a plane has two rotations. So several hypotheses are refined
under perspective by `tracking3d.bundle_adjustment.adjustment`, and the distinct ones are kept; rendering them shows
which is correct.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tracking3d.bundle_adjustment.adjustment import Structure, Tracks, adjust
from tracking3d.bundle_adjustment.reprojection import FloatArray
from tracking3d.estimation.online.initialization.factorization import (
    affine_motion,
    assumed_relief,
    measured_relief,
    metric_structure,
)
from tracking3d.estimation.online.initialization.planar import is_planar, planar_structures
from tracking3d.estimation.online.initialization.registration import FEWEST, register_all, subset_of

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
